"""The commands that lead from photographs as cameras write them to a capture: import, board, calibrate, register."""

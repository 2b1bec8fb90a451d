"""Commands from photographs as cameras write them to a capture: import, board, calibrate, landmarks, register."""

"""Detection of boards in photographs, and calibration of the lenses and poses of all cameras of a rig."""

"""What a calibration has measured of a rig, and how sure it is."""

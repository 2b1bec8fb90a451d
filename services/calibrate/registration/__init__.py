"""Where the teeth of a scan stand in the rig: a rigid pose from landmarks, then from outlines, with its covariance."""

"""Registration of a scan's teeth in the rig: a rigid pose from landmarks, refined on outlines, with its covariance."""

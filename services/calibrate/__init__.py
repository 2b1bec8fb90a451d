"""From photographs of boards, spheres and charts to a calibration that knows its own errors."""

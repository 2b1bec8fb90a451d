"""Measurement of the jaws' motion between frames, and alignment of frames with the first one."""

"""Ground floor: what a capture's source gives, and what a camera's view shows of the surfaces."""

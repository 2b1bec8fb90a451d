"""A page in which a person clicks landmarks in a scan and in photographs."""

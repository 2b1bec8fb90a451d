"""Average teeth, arches and gums, built from published dimensions."""

"""The secrets of a deployment, and the change of its database password."""

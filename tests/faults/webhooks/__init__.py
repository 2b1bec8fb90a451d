"""Webhooks under faults of the receiver, the network and the server."""

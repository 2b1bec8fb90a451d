"""What every route shares: bodies, problem documents, files, limits, thread pools, connections."""

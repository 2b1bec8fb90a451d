"""HTTP parts that all routes share: request bodies, problem documents, files, limits, thread pools, connections."""

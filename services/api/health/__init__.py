"""Whether the service and its workers are well: readiness, metrics, workers."""

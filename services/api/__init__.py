"""Jobs, routes, dashboard, and the pipeline that strings the stages together."""

"""The server: REST routes, jobs and their queue, and the dashboard."""

"""The typed client of the API, with uploads and progress; it needs neither database nor server."""

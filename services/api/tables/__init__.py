"""Tables of the database, the lifecycle of a job, and the outbox of events: what every part of the server builds on."""

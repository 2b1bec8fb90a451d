"""Authentication and authorisation: tokens, sessions, scopes, owners, the audit log, protection of browsers."""

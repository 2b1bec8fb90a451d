"""Who asks and what they may do: tokens, sessions, scopes, owners, the audit log, protection of browsers."""

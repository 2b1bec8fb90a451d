"""Webhooks: subscriptions, the outbox and deliveries."""

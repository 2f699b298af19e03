"""Published methods, as objectives, optimizers, starts and events like a user's own."""

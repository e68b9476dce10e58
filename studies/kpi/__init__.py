"""Key figures of closed loops."""

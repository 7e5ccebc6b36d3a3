"""Access: keys of callers with their limits, and certificates."""

"""Conversations simulated and filtered in torch, many at once, and a training on them by the clock: for a GPU."""

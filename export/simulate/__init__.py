"""Conversations with a robot, simulated from speech, rooms, noises and physical effects."""

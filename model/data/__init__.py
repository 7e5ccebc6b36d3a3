"""Recorded scenes: readers, and what training and evaluation make of them."""

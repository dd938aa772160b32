"""Verified pairs as a graph of images."""

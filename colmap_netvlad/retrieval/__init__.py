"""Retrieval: from a project to a ranking, one file a method."""

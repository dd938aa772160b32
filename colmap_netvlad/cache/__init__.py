"""What is kept beside the database, so that nothing is computed twice."""

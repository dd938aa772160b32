"""What the user reads: tables, plots, the page of a comparison."""

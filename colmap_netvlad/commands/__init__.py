"""What each command does, whoever calls it: one file a command."""

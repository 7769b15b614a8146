"""What an operator sees of a process: log lines, metrics and traces. Knows nothing of what it reports on."""

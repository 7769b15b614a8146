"""The worker: takes jobs from the database, fits maps in child processes, and hands over when it dies."""

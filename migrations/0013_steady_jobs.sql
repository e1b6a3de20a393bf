-- Attempts are what a job is to blame for; how often it waited for disk or database is counted apart, and only makes it wait longer.
ALTER TABLE jobs ADD COLUMN waits INTEGER NOT NULL DEFAULT 0;

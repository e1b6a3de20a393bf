-- Which jobs workers hold: few, however many wait.
CREATE INDEX jobs_held ON jobs (lane, project_id) WHERE worker IS NOT NULL;

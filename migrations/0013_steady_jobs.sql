-- Attempts are what a job is to blame for; how often it waited for disk or database is counted apart, and only makes it wait longer.
ALTER TABLE jobs ADD COLUMN waits INTEGER NOT NULL DEFAULT 0;

-- Scans that were deleted and that the model may still hold.
CREATE INDEX scans_to_be_forgotten ON scans (project_id) WHERE deleted_ms IS NOT NULL AND forgotten_ms IS NULL;

-- Asked with every renewal of a claim and every look of a worker's watch: the members of a batch, and the jobs of a scan.
CREATE INDEX jobs_of_leader ON jobs (leader) WHERE leader IS NOT NULL;
CREATE INDEX jobs_of_scan ON jobs (scan_id) WHERE scan_id IS NOT NULL;

-- Messages to webhooks that wait, in their order, and those that have ended, by when: their upkeep passes over all others.
CREATE INDEX deliveries_pending ON deliveries (webhook_id, seq, not_before_ms) WHERE state = 'pending';
CREATE INDEX deliveries_by_end ON deliveries (ended_ms) WHERE ended_ms IS NOT NULL;

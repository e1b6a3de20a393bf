-- What keeps a service alive for weeks: damage that was found, turns of projects, and jobs that crash.

-- Blobs that a row needs and whose file is missing or no longer has its hash. A line stays until the file is sound again or
-- nothing needs it any more; operators see the open ones.
CREATE TABLE damage (
    blob        TEXT PRIMARY KEY,
    finding     TEXT NOT NULL CHECK (finding IN ('missing', 'altered')),
    found_ms    INTEGER NOT NULL,
    settled_ms  INTEGER                      -- NULL: still so
) STRICT;

-- Workers serve projects in turn: whose turn was longest ago comes first, in each lane.
ALTER TABLE projects ADD COLUMN ingest_turn INTEGER NOT NULL DEFAULT 0;
ALTER TABLE projects ADD COLUMN map_turn INTEGER NOT NULL DEFAULT 0;
CREATE INDEX jobs_open_of_project ON jobs (lane, project_id, seq) WHERE state IN ('accepted', 'running');

-- How often the process that did nothing but this job died, or did not end in time: a job that does this again is the cause.
ALTER TABLE jobs ADD COLUMN crashes INTEGER NOT NULL DEFAULT 0;

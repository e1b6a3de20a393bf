-- Who may do what: keys, on whose account things are, and who is told when a job ends.

CREATE TABLE keys (
    id               TEXT PRIMARY KEY,
    name             TEXT NOT NULL,
    digest           BLOB NOT NULL,              -- 32 bytes: hash of the secret, which is kept nowhere
    scope            TEXT NOT NULL CHECK (scope IN ('read', 'upload', 'manage')),
    every_project    INTEGER NOT NULL CHECK (every_project IN (0, 1)),
    max_bytes        INTEGER,                    -- of its uploads; NULL: no limit
    max_scans        INTEGER,
    max_queued_jobs  INTEGER,
    created_ms       INTEGER NOT NULL,
    expires_ms       INTEGER,
    revoked_ms       INTEGER
) STRICT;

-- The projects of a key that has not all.
CREATE TABLE key_projects (
    key_id      TEXT NOT NULL REFERENCES keys (id) ON DELETE CASCADE,
    project_id  TEXT NOT NULL REFERENCES projects (id) ON DELETE CASCADE,
    PRIMARY KEY (key_id, project_id)
) STRICT, WITHOUT ROWID;

CREATE INDEX key_projects_by_project ON key_projects (project_id);

-- The key that sent or asked for it; NULL: somebody without one.
ALTER TABLE scans ADD COLUMN key_id TEXT;
ALTER TABLE jobs ADD COLUMN key_id TEXT;
CREATE INDEX scans_of_key ON scans (key_id) WHERE key_id IS NOT NULL;
CREATE INDEX open_jobs_of_key ON jobs (key_id) WHERE key_id IS NOT NULL AND state IN ('accepted', 'running');
CREATE INDEX jobs_by_end ON jobs (finished_ms) WHERE finished_ms IS NOT NULL;

-- Addresses that are told of the ends of a project's jobs.
CREATE TABLE webhooks (
    seq         INTEGER PRIMARY KEY AUTOINCREMENT,
    id          TEXT NOT NULL UNIQUE,
    project_id  TEXT NOT NULL REFERENCES projects (id) ON DELETE CASCADE,
    url         TEXT NOT NULL,
    secret      BLOB NOT NULL,                   -- signs what is sent, so it has to be kept as it is
    created_ms  INTEGER NOT NULL
) STRICT;

CREATE INDEX webhooks_of_project ON webhooks (project_id, seq);

-- One message to one address. It is made with the end of the job, in the same transaction, so none is forgotten.
CREATE TABLE deliveries (
    seq            INTEGER PRIMARY KEY AUTOINCREMENT,
    id             TEXT NOT NULL UNIQUE,
    webhook_id     TEXT NOT NULL REFERENCES webhooks (id) ON DELETE CASCADE,
    job_id         TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    state          TEXT NOT NULL DEFAULT 'pending' CHECK (state IN ('pending', 'delivered', 'failed')),
    attempts       INTEGER NOT NULL DEFAULT 0,
    not_before_ms  INTEGER NOT NULL DEFAULT 0,   -- a retry waits until then
    status         INTEGER,                      -- what the address answered last
    error          TEXT,                         -- why the last attempt came to nothing
    created_ms     INTEGER NOT NULL,
    ended_ms       INTEGER
) STRICT;

CREATE INDEX deliveries_of_webhook ON deliveries (webhook_id, seq);
CREATE INDEX deliveries_of_job ON deliveries (job_id);
CREATE INDEX deliveries_due ON deliveries (not_before_ms) WHERE state = 'pending';

CREATE TRIGGER job_ended AFTER UPDATE OF state ON jobs
    WHEN new.state IN ('succeeded', 'failed', 'dismissed') AND old.state IN ('accepted', 'running')
BEGIN
    INSERT INTO deliveries (id, webhook_id, job_id, created_ms)
        SELECT lower(hex(randomblob(16))), id, new.id, new.updated_ms FROM webhooks WHERE project_id = new.project_id;
END;

-- Written now and then to see whether the database can be written.
CREATE TABLE probe (
    id     INTEGER PRIMARY KEY CHECK (id = 1),
    at_ms  INTEGER NOT NULL
) STRICT;

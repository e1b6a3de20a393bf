-- The first schema. Times are milliseconds since 1970, ids are ULIDs in text, and blobs are named by their BLAKE3
-- hash in hexadecimal. Large things are never in here: they are files below blobs/.

CREATE TABLE projects (
    id          TEXT PRIMARY KEY,
    name        TEXT NOT NULL,
    seed        INTEGER NOT NULL,
    resolution  REAL,                        -- metres; NULL: chosen from the first scans
    head        INTEGER NOT NULL DEFAULT 0,  -- number of the newest version; 0 is the empty model
    arrivals    INTEGER NOT NULL DEFAULT 0,  -- scans ever acknowledged, deleted ones included
    created_ms  INTEGER NOT NULL
) STRICT;

CREATE TABLE scans (
    id              TEXT PRIMARY KEY,
    project_id      TEXT NOT NULL REFERENCES projects (id) ON DELETE CASCADE,
    content_key     BLOB NOT NULL,           -- 16 bytes: hash of the upload and of how it is read
    name            TEXT NOT NULL,
    format          TEXT NOT NULL,
    blob            TEXT NOT NULL,           -- the upload as it came
    bytes           INTEGER NOT NULL,
    interpretation  TEXT NOT NULL,           -- JSON: units and sensor position
    arrival         INTEGER NOT NULL,        -- how many scans of the project came before
    state           TEXT NOT NULL
        CHECK (state IN ('received', 'ingested', 'registered', 'waiting', 'failed', 'dismissed')),
    standing        TEXT,                    -- JSON: where it stands in the newest version, or why it failed
    points          INTEGER,
    colored         INTEGER,                 -- 1 if the points have colours
    extent          REAL,                    -- metres
    scale           REAL,                    -- the resolution that suits it alone, metres
    job_id          TEXT NOT NULL,           -- the job that registers it
    created_ms      INTEGER NOT NULL,
    deleted_ms      INTEGER,                 -- set at once when a client deletes it
    forgotten_ms    INTEGER                  -- set when the model holds it no more: its upload may go
) STRICT;

-- The same content is one scan of a project, however often it is sent.
CREATE UNIQUE INDEX scans_by_content ON scans (project_id, content_key) WHERE deleted_ms IS NULL;
CREATE UNIQUE INDEX scans_by_arrival ON scans (project_id, arrival);

CREATE TABLE jobs (
    seq           INTEGER PRIMARY KEY AUTOINCREMENT,  -- order of acceptance
    id            TEXT NOT NULL UNIQUE,
    project_id    TEXT NOT NULL REFERENCES projects (id) ON DELETE CASCADE,
    scan_id       TEXT REFERENCES scans (id) ON DELETE CASCADE,
    kind          TEXT NOT NULL,
    lane          TEXT NOT NULL CHECK (lane IN ('ingest', 'map')),
    state         TEXT NOT NULL CHECK (state IN ('accepted', 'running', 'succeeded', 'failed', 'dismissed')),
    stage         TEXT,
    progress      INTEGER NOT NULL DEFAULT 0,
    worker        TEXT,                               -- who holds it; NULL: nobody
    leader        TEXT,                               -- the job whose worker maps this one in its batch
    attempt       INTEGER NOT NULL DEFAULT 0,         -- grows with every claim: the fencing token
    tries         INTEGER NOT NULL DEFAULT 0,         -- how often it failed in this lane
    losses        INTEGER NOT NULL DEFAULT 0,         -- how often its worker died while it was alone with it
    lease_ms      INTEGER,                            -- the holder is taken for dead after this moment
    not_before_ms INTEGER NOT NULL DEFAULT 0,         -- a retry waits until then
    outcome       TEXT,                               -- JSON
    fault         TEXT,                               -- JSON
    revision      INTEGER NOT NULL DEFAULT 1,         -- grows with every change that a client can see
    created_ms    INTEGER NOT NULL,
    started_ms    INTEGER,
    finished_ms   INTEGER,
    updated_ms    INTEGER NOT NULL
) STRICT;

CREATE INDEX jobs_of_project ON jobs (project_id, seq);
CREATE INDEX jobs_open ON jobs (lane, seq) WHERE state IN ('accepted', 'running');
-- Mapping is serial in a project, whatever the workers do.
CREATE UNIQUE INDEX jobs_one_mapper ON jobs (project_id) WHERE lane = 'map' AND worker IS NOT NULL;

CREATE TABLE versions (
    project_id  TEXT NOT NULL REFERENCES projects (id) ON DELETE CASCADE,
    number      INTEGER NOT NULL,
    job_id      TEXT NOT NULL,
    kind        TEXT NOT NULL,
    snapshot    TEXT NOT NULL,               -- blob: the engine's state; kept for the newest version only
    content     TEXT NOT NULL,               -- blob: what readers see
    engine      TEXT NOT NULL,               -- parameters under which its scans were prepared and its pairs matched
    resolution  REAL NOT NULL,               -- metres
    components  INTEGER NOT NULL,
    registered  INTEGER NOT NULL,
    waiting     INTEGER NOT NULL,
    created_ms  INTEGER NOT NULL,
    PRIMARY KEY (project_id, number)
) STRICT;

-- Results of pairs, a pure function of two scans and the engine's parameters.
CREATE TABLE pairs (
    project_id  TEXT NOT NULL REFERENCES projects (id) ON DELETE CASCADE,
    engine      TEXT NOT NULL,
    a           BLOB NOT NULL,               -- content keys, a < b
    b           BLOB NOT NULL,
    result      BLOB NOT NULL,
    PRIMARY KEY (project_id, engine, a, b)
) STRICT, WITHOUT ROWID;

-- Blobs that can be computed again: prepared scans, merged clouds, pictures. They go with whose they are; whoever
-- else made use of one makes it again.
CREATE TABLE derived (
    cache_key   TEXT PRIMARY KEY,            -- hash of kind, parameters and inputs
    project_id  TEXT NOT NULL REFERENCES projects (id) ON DELETE CASCADE,
    scan_id     TEXT REFERENCES scans (id) ON DELETE CASCADE,  -- NULL: made of several scans
    blob        TEXT NOT NULL,
    bytes       INTEGER NOT NULL,
    created_ms  INTEGER NOT NULL
) STRICT;

-- Blobs that have lost a reference. The collector deletes the files of those that have no other.
CREATE TABLE garbage (
    blob        TEXT PRIMARY KEY
) STRICT;

CREATE INDEX scans_by_blob ON scans (blob);
CREATE INDEX versions_by_snapshot ON versions (snapshot);
CREATE INDEX versions_by_content ON versions (content);
CREATE INDEX derived_by_blob ON derived (blob);
CREATE INDEX derived_of_project ON derived (project_id, scan_id);
CREATE INDEX derived_of_scan ON derived (scan_id);

CREATE TRIGGER scan_forgotten AFTER UPDATE OF forgotten_ms ON scans BEGIN
    INSERT OR IGNORE INTO garbage VALUES (old.blob);
END;
CREATE TRIGGER scan_gone AFTER DELETE ON scans BEGIN
    INSERT OR IGNORE INTO garbage VALUES (old.blob);
END;
CREATE TRIGGER head_moved AFTER UPDATE OF head ON projects BEGIN
    INSERT OR IGNORE INTO garbage SELECT snapshot FROM versions WHERE project_id = old.id AND number = old.head;
END;
CREATE TRIGGER version_gone AFTER DELETE ON versions BEGIN
    INSERT OR IGNORE INTO garbage VALUES (old.snapshot), (old.content);
END;
CREATE TRIGGER derived_gone AFTER DELETE ON derived BEGIN
    INSERT OR IGNORE INTO garbage VALUES (old.blob);
END;
CREATE TRIGGER derived_replaced AFTER UPDATE OF blob ON derived WHEN old.blob <> new.blob BEGIN
    INSERT OR IGNORE INTO garbage VALUES (old.blob);
END;

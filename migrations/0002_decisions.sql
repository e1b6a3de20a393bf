-- What clients decided about pairs of scans, where the data alone cannot tell. Every job that changes a model obeys what is in
-- here when it starts.

CREATE TABLE decisions (
    seq         INTEGER PRIMARY KEY AUTOINCREMENT,  -- the order in which they were made
    id          TEXT NOT NULL UNIQUE,
    project_id  TEXT NOT NULL REFERENCES projects (id) ON DELETE CASCADE,
    scan_a      TEXT NOT NULL REFERENCES scans (id) ON DELETE CASCADE,
    scan_b      TEXT NOT NULL REFERENCES scans (id) ON DELETE CASCADE,
    verdict     TEXT NOT NULL,                      -- JSON: join or forbid, and the pose
    created_ms  INTEGER NOT NULL
) STRICT;

CREATE INDEX decisions_of_project ON decisions (project_id, seq);
CREATE INDEX decisions_of_scan_a ON decisions (scan_a);
CREATE INDEX decisions_of_scan_b ON decisions (scan_b);

-- Nothing is decided about a scan that a client has deleted.
CREATE TRIGGER scan_deleted AFTER UPDATE OF deleted_ms ON scans WHEN new.deleted_ms IS NOT NULL BEGIN
    DELETE FROM decisions WHERE scan_a = old.id OR scan_b = old.id;
END;

-- Uploads that arrive in several requests. Their bytes lie in uploads/, in a file named by the id, until the last one has come.

CREATE TABLE uploads (
    id              TEXT PRIMARY KEY,
    project_id      TEXT NOT NULL REFERENCES projects (id) ON DELETE CASCADE,
    name            TEXT NOT NULL,
    interpretation  TEXT NOT NULL,               -- JSON: units and sensor position
    metadata        TEXT NOT NULL,               -- what the client said about it, word for word
    length          INTEGER NOT NULL,            -- bytes that it will have
    received        INTEGER NOT NULL DEFAULT 0,  -- bytes that are synced; equal to length only once its scan is acknowledged
    blob            TEXT,                        -- hash of all bytes, set before the file moves to blobs/
    scan_id         TEXT REFERENCES scans (id) ON DELETE CASCADE,  -- the scan that it became
    job_id          TEXT,
    duplicate       INTEGER,                     -- 1 if the project had the content already
    created_ms      INTEGER NOT NULL,
    expires_ms      INTEGER NOT NULL             -- moves on with every piece
) STRICT;

CREATE INDEX uploads_by_expiry ON uploads (expires_ms);
CREATE INDEX uploads_of_project ON uploads (project_id);
CREATE INDEX uploads_of_scan ON uploads (scan_id);
CREATE INDEX uploads_by_blob ON uploads (blob);

-- Once an upload is a scan, the scan's row needs the blob.
CREATE TRIGGER upload_gone AFTER DELETE ON uploads WHEN old.blob IS NOT NULL BEGIN
    INSERT OR IGNORE INTO garbage VALUES (old.blob);
END;
CREATE TRIGGER upload_reopened AFTER UPDATE OF blob ON uploads WHEN old.blob IS NOT NULL AND new.blob IS NOT old.blob BEGIN
    INSERT OR IGNORE INTO garbage VALUES (old.blob);
END;

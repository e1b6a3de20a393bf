-- What projects and keys hold, kept with each change of a scan: a limit is looked up, however many scans there are.

CREATE TABLE holdings (
    holder  TEXT PRIMARY KEY,                -- id of a project or of a key
    scans   INTEGER NOT NULL,                -- that were not deleted
    bytes   INTEGER NOT NULL                 -- of their uploads
) STRICT, WITHOUT ROWID;

INSERT INTO holdings SELECT project_id, COUNT(*), SUM(bytes) FROM scans WHERE deleted_ms IS NULL GROUP BY project_id;
INSERT INTO holdings
    SELECT key_id, COUNT(*), SUM(bytes) FROM scans WHERE deleted_ms IS NULL AND key_id IS NOT NULL GROUP BY key_id;

CREATE TRIGGER scan_held AFTER INSERT ON scans WHEN new.deleted_ms IS NULL BEGIN
    INSERT INTO holdings VALUES (new.project_id, 1, new.bytes)
        ON CONFLICT DO UPDATE SET scans = scans + 1, bytes = bytes + excluded.bytes;
    INSERT INTO holdings SELECT new.key_id, 1, new.bytes WHERE new.key_id IS NOT NULL
        ON CONFLICT DO UPDATE SET scans = scans + 1, bytes = bytes + excluded.bytes;
END;
CREATE TRIGGER scan_let_go AFTER UPDATE OF deleted_ms ON scans WHEN old.deleted_ms IS NULL AND new.deleted_ms IS NOT NULL BEGIN
    UPDATE holdings SET scans = scans - 1, bytes = bytes - old.bytes WHERE holder IN (old.project_id, old.key_id);
END;
CREATE TRIGGER scan_lost AFTER DELETE ON scans WHEN old.deleted_ms IS NULL BEGIN
    UPDATE holdings SET scans = scans - 1, bytes = bytes - old.bytes WHERE holder IN (old.project_id, old.key_id);
END;
CREATE TRIGGER project_gone AFTER DELETE ON projects BEGIN
    DELETE FROM holdings WHERE holder = old.id;
END;

-- Uploads that are to come, and nothing else of them: those that have ended stay a while.
CREATE INDEX uploads_coming_to_project ON uploads (project_id, expires_ms, id, length) WHERE scan_id IS NULL;
CREATE INDEX uploads_coming_from_key ON uploads (key_id, expires_ms, id, length) WHERE scan_id IS NULL AND key_id IS NOT NULL;

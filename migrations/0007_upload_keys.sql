-- The key that announced an upload: on its account the scan will be, and until then the bytes.
ALTER TABLE uploads ADD COLUMN key_id TEXT;
CREATE INDEX uploads_of_key ON uploads (key_id) WHERE key_id IS NOT NULL;

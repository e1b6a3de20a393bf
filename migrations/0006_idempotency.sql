-- Answers to requests that carried an Idempotency-Key, to be given again when the request comes again.

CREATE TABLE answers (
    scope       TEXT NOT NULL,               -- who asked: keys of different clients are different keys
    key         TEXT NOT NULL,
    request     BLOB NOT NULL,               -- 32 bytes: hash of method, address, some headers and body
    status      INTEGER NOT NULL,
    headers     TEXT NOT NULL,               -- JSON: pairs of name and value
    body        BLOB NOT NULL,
    expires_ms  INTEGER NOT NULL,
    PRIMARY KEY (scope, key)
) STRICT, WITHOUT ROWID;

CREATE INDEX answers_by_expiry ON answers (expires_ms);

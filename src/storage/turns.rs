//! Whose turn it is: the SQL that picks the next job of a lane, so that projects take turns and nothing is worked on before what it depends on.
//! Used by `claims`.

/// Arrival of the eighth scan of a job's project that takes part, NULL if there are fewer.
const EIGHTH: &str =
    "(SELECT e.arrival FROM scans e WHERE e.project_id = j.project_id AND e.deleted_ms IS NULL
    AND e.state NOT IN ('failed', 'dismissed') ORDER BY e.arrival LIMIT 1 OFFSET 7)";

/// Jobs `j` (with their scans `s`) of a project that nobody maps now which may be mapped. A registration waits for removals before
/// it, and, from the ninth scan on, until the first eight are decoded, because these decide the resolution. What works on the
/// whole model waits for everything that was accepted before it.
pub(super) fn may_be_mapped() -> String {
    format!(
        "j.lane = 'map' AND j.state IN ('accepted', 'running') AND j.worker IS NULL AND j.leader IS NULL
           AND j.not_before_ms <= ?1
           AND CASE j.kind
             WHEN 'removal' THEN 1
             WHEN 'registration' THEN
               NOT EXISTS (SELECT 1 FROM jobs r WHERE r.project_id = j.project_id AND r.kind = 'removal'
                           AND r.state IN ('accepted', 'running') AND r.lane = 'map' AND r.seq < j.seq)
               AND (s.arrival <= COALESCE({EIGHTH}, s.arrival)
                    OR NOT EXISTS (SELECT 1 FROM scans f JOIN jobs i ON i.id = f.job_id
                                   WHERE f.project_id = j.project_id AND f.arrival <= {EIGHTH}
                                     AND i.lane = 'ingest' AND i.state IN ('accepted', 'running')))
             ELSE NOT EXISTS (SELECT 1 FROM jobs e WHERE e.project_id = j.project_id
                              AND e.state IN ('accepted', 'running') AND e.lane IN ('ingest', 'map') AND e.seq < j.seq)
           END"
    )
}

/// The job to be mapped next: mapping is serial in a project, and projects take turns, so that a thousand scans of one do not keep
/// another's single scan waiting. In a project the oldest comes first.
pub(super) fn next_to_map() -> String {
    let may_be_mapped = may_be_mapped();
    format!(
        "SELECT seq FROM (
           SELECT p.map_turn AS turn, (SELECT j.seq FROM jobs j LEFT JOIN scans s ON s.id = j.scan_id
                                       WHERE j.project_id = p.id AND {may_be_mapped} ORDER BY j.seq LIMIT 1) AS seq
           FROM projects p
           WHERE NOT EXISTS (SELECT 1 FROM jobs h WHERE h.project_id = p.id AND h.lane = 'map' AND h.worker IS NOT NULL))
         WHERE seq IS NOT NULL ORDER BY turn, seq LIMIT 1"
    )
}

/// The job to be ingested next: of the project that the fewest workers are at, and of those the one whose turn was longest ago.
pub(super) const NEXT_TO_INGEST: &str = "
    SELECT seq FROM (
      SELECT p.ingest_turn AS turn,
        (SELECT j.seq FROM jobs j WHERE j.project_id = p.id AND j.lane = 'ingest' AND j.state IN ('accepted', 'running')
           AND j.worker IS NULL AND j.not_before_ms <= ?1 ORDER BY j.seq LIMIT 1) AS seq,
        (SELECT COUNT(*) FROM jobs w WHERE w.project_id = p.id AND w.lane = 'ingest' AND w.worker IS NOT NULL) AS workers
      FROM projects p)
    WHERE seq IS NOT NULL ORDER BY workers, turn, seq LIMIT 1";

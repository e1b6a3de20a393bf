//! Registration recall as published, to print beside ours.

/// One row of a published table.
pub(super) struct Published {
    /// Who, by the name of the paper or method, and with which features.
    pub method: &'static str,
    /// 3DMatch, percent.
    pub match_percent: f64,
    /// 3DLoMatch, percent.
    pub lo_percent: f64,
}

const fn row(method: &'static str, match_percent: f64, lo_percent: f64) -> Published {
    Published { method, match_percent, lo_percent }
}

/// Multiview registration recall (0.2 m) of all eight test scenes of 3DMatch, as in the tables of SGHR (Wang et al., "Robust Multiview
/// Point Cloud Registration with Reliable Pose Graph Initialization and History Reweighting", CVPR 2023) and of "Incremental Multiview
/// Point Cloud Registration". All use learned features, trained on the training scenes of 3DMatch.
pub(super) const PUBLISHED: [Published; 12] = [
    row("maximum spanning tree, full graph, SpinNet", 80.3, 52.7),
    row("maximum spanning tree, full graph, YOHO", 80.9, 54.3),
    row("maximum spanning tree, full graph, GeoTransformer", 82.1, 59.7),
    row("HARA, SpinNet", 82.7, 63.6),
    row("HARA, YOHO", 83.1, 68.7),
    row("HARA, GeoTransformer", 83.4, 68.5),
    row("SGHR, SpinNet", 94.9, 80.0),
    row("SGHR, YOHO", 96.2, 81.6),
    row("SGHR, GeoTransformer", 95.9, 83.0),
    row("Incremental Multiview Point Cloud Registration, SpinNet", 94.6, 82.5),
    row("Incremental Multiview Point Cloud Registration, YOHO", 96.3, 84.4),
    row("Incremental Multiview Point Cloud Registration, GeoTransformer", 97.3, 87.1),
];

//! Adjustments that are taken back where they harm: that throw scans off their edges, or bend what was straight. Used by `mapper`.

use super::component::Component;
use super::consistency::thrown;
use super::options::MappingOptions;
use super::refine::{Reach, dense, pose_graph};
use super::surfaces::judge_inside;
use crate::control::{Cancelled, Control};
use crate::graph::ScanGraph;

/// More in free space than there was, by this factor, is noticed. Where nothing bends it comes to 0.98 to 1.03 times as much, and a second dense adjustment
/// would double what a refinement takes; bends show by 1.3 times and more.
const NOTICEABLE: f64 = 1.05;

/// A component after the pose graph and the joint dense adjustment; where these leave noticeably more in free space than there was, after the dense
/// adjustment alone if that leaves less: edges of little overlap all slide the same way, and a pose graph of such edges bends what was straight.
pub fn refined(
    graph: &ScanGraph,
    component: &Component,
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<Component, Cancelled> {
    let violation = |component: &Component| judge_inside(graph, component).violation_share();
    let on_surfaces = |mut component: Component| {
        guarded(graph, &mut component, options, |component| {
            dense(graph, component, None, Reach::NEAR, voxel, control).map(drop)
        })?;
        Ok(component)
    };
    let mut spread = component.clone();
    guarded(graph, &mut spread, options, |component| {
        pose_graph(graph, component, Reach::NEAR, voxel, options, control)
    })?;
    let spread = on_surfaces(spread)?;
    let bent = violation(&spread);
    if bent <= NOTICEABLE * violation(component) {
        return Ok(spread);
    }
    let alone = on_surfaces(component.clone())?;
    Ok(if violation(&alone) < bent { alone } else { spread })
}

/// Runs an adjustment and takes it back if it throws a scan off its edges.
pub fn guarded(
    graph: &ScanGraph,
    component: &mut Component,
    options: &MappingOptions,
    adjust: impl FnOnce(&mut Component) -> Result<(), Cancelled>,
) -> Result<(), Cancelled> {
    let mut adjusted = component.clone();
    adjust(&mut adjusted)?;
    if thrown(graph, component, &adjusted, options).is_empty() {
        *component = adjusted;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::cloud::ScanKey;
    use crate::control::{CancelToken, Silent};
    use crate::geometry::Pose;
    use crate::graph::SupportOptions;
    use crate::mapping::test_hall::Model;
    use crate::pairwise::{Counts, Evidence, Hypothesis, PairKey, PairResult};

    /// How far two scans of a hall end from where they belong, in voxels, by the pose graph alone and refined, if their pair is sure that one stands so many
    /// voxels aside.
    fn off(shift_voxels: f64) -> [f64; 2] {
        let (model, options) = (Model::new(2), MappingOptions::default());
        let voxel = model.hall.resolution;
        let truth = model.contradiction((1, 2), true).a_from_b;
        let counts = Counts { points: 1000, inliers: 500, ..Counts::default() };
        let result = PairResult {
            pair: PairKey::of(ScanKey(1), ScanKey(2)),
            matches: Vec::new(),
            hypotheses: vec![Hypothesis {
                a_from_b: Pose::from_translation(Vector3::new(shift_voxels * voxel, 0.0, 0.0)) * truth,
                evidence: Evidence { b_on_a: counts, a_on_b: counts, range_images: 2, ..Evidence::default() },
                logit: 8.0,
            }],
        };
        let mut graph = model.graph.clone();
        graph.add_results([result], &SupportOptions::default());
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let mut spread = model.component.clone();
        pose_graph(&graph, &mut spread, Reach::NEAR, voxel, &options, control).expect("nobody cancels");
        let both = refined(&graph, &model.component, voxel, &options, control).expect("nobody cancels");
        [spread, both].map(|component| {
            let a_from_b = component.poses[&ScanKey(1)].inverse() * component.poses[&ScanKey(2)];
            (a_from_b.translation - truth.translation).norm() / voxel
        })
    }

    #[test]
    fn what_an_edge_bends_into_free_space_is_adjusted_without_it() {
        let far = 0.8 * MappingOptions::default().rival_voxels;
        let [spread, refined] = off(far);
        assert!(spread > 0.9 * far, "the edge moves it: {spread} of {far} voxels");
        assert!(refined < 0.5, "surfaces alone hold it: {refined} voxels");
        let [spread, refined] = off(1.0);
        assert!(
            spread > 0.9 && refined < 0.5,
            "surfaces bring back what is near: {spread}, {refined} voxels"
        );
    }
}

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

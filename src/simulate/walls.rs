//! Solids of a floor plan: walls with their openings, door and window frames, door leaves, panes, floor and ceilings.
//! Uses the plan; used by the building.

use nalgebra::Vector3;

use super::furniture::yaw;
use super::openings::{Opening, OpeningKind};
use super::plan::{Plan, Wall};
use super::solid::{Material, Solid};

/// All solids of the plan, without furniture.
pub(super) fn shell(plan: &Plan) -> Vec<Solid> {
    let mut solids: Vec<Solid> = plan.walls.iter().flat_map(|wall| wall_solids(wall, plan.height)).collect();
    for room in &plan.rooms {
        let ([x0, y0], [x1, y1]) = (room.low, room.high);
        // The wall's tops reach above the ceiling, so a slab of the room's own size leaves no gap.
        let top = plan.height + 0.1;
        solids.push(Solid::between(Vector3::new(x0, y0, room.height), Vector3::new(x1, y1, top)));
    }
    let low = plan.walls.iter().map(wall_low).fold(Vector3::zeros(), |a, b| a.inf(&b));
    let high = plan.walls.iter().map(wall_high).fold(Vector3::zeros(), |a, b| a.sup(&b));
    solids.push(Solid::between(Vector3::new(low.x, low.y, -0.2), Vector3::new(high.x, high.y, 0.0)));
    solids
}

fn wall_low(wall: &Wall) -> Vector3<f32> {
    point(wall, wall.from, -wall.thickness * 0.5, 0.0)
}

fn wall_high(wall: &Wall) -> Vector3<f32> {
    point(wall, wall.to, wall.thickness * 0.5, 0.0)
}

/// The world's coordinates of a point given along the wall, across it from its middle, and above the floor.
fn point(wall: &Wall, along: f32, across: f32, z: f32) -> Vector3<f32> {
    match wall.axis {
        0 => Vector3::new(along, wall.at + across, z),
        _ => Vector3::new(wall.at + across, along, z),
    }
}

/// A cuboid of a wall: an interval along it, half its depth, and an interval above the floor.
pub(super) fn part(wall: &Wall, (from, to): (f32, f32), half_depth: f32, (low, high): (f32, f32)) -> Solid {
    Solid::between(point(wall, from, -half_depth, low), point(wall, to, half_depth, high))
}

fn wall_solids(wall: &Wall, height: f32) -> Vec<Solid> {
    let half = wall.thickness * 0.5;
    let mut openings = wall.openings.clone();
    openings.sort_by(|a, b| a.from.total_cmp(&b.from));
    let mut solids = Vec::new();
    let mut from = wall.from;
    for opening in &openings {
        let stretch = (opening.from, opening.to);
        solids.extend(stretch_of(wall, (from, opening.from), height));
        solids.push(part(wall, stretch, half, (opening.head, height)));
        if opening.sill > 0.0 {
            solids.push(part(wall, stretch, half, (0.0, opening.sill)));
        }
        solids.extend(frame(wall, opening));
        from = opening.to;
    }
    solids.extend(stretch_of(wall, (from, wall.to), height));
    solids
}

/// A stretch of wall without openings: solid, or panes between posts and rails.
fn stretch_of(wall: &Wall, (from, to): (f32, f32), height: f32) -> Vec<Solid> {
    const RAIL: f32 = 0.06;
    if !wall.glazed {
        return vec![part(wall, (from, to), wall.thickness * 0.5, (0.0, height))];
    }
    let panes = ((to - from) / 1.3).ceil().max(1.0);
    let mut solids = vec![
        part(wall, (from, to), 0.03, (0.0, RAIL)),
        part(wall, (from, to), 0.03, (height - 5.0 * RAIL, height)),
        part(wall, (from, to), 0.005, (RAIL, height - 5.0 * RAIL)).of(Material::Glass),
    ];
    solids.extend((0..=panes as usize).map(|i| {
        let at = from + (to - from) * i as f32 / panes;
        part(wall, (at - 0.025, at + 0.025), 0.03, (0.0, height))
    }));
    solids
}

/// Jambs and lintel, and what else belongs to the kind of opening.
fn frame(wall: &Wall, opening: &Opening) -> Vec<Solid> {
    let Opening { from, to, sill, head, kind } = *opening;
    let proud = wall.thickness * 0.5 + 0.015;
    let bar = 0.06;
    let mut solids = Vec::new();
    match kind {
        OpeningKind::Passage | OpeningKind::Door(_) | OpeningKind::GlassDoor(_) => {
            solids.push(part(wall, (from - bar, from + 0.02), proud, (0.0, head + bar)));
            solids.push(part(wall, (to - 0.02, to + bar), proud, (0.0, head + bar)));
            solids.push(part(wall, (from, to), proud, (head - 0.02, head + bar)));
        }
        OpeningKind::Hole | OpeningKind::Pane => {
            solids.push(part(
                wall,
                (from - 0.05, to + 0.05),
                wall.thickness * 0.5 + 0.12,
                (sill - 0.03, sill),
            ));
            solids.push(part(wall, (from, from + bar), 0.035, (sill, head)));
            solids.push(part(wall, (to - bar, to), 0.035, (sill, head)));
            solids.push(part(wall, (from, to), 0.035, (head - bar, head)));
            let middle = (from + to) * 0.5;
            solids.push(part(wall, (middle - 0.03, middle + 0.03), 0.03, (sill, head)));
        }
    }
    match kind {
        OpeningKind::Pane => solids.push(part(wall, (from, to), 0.004, (sill, head)).of(Material::Glass)),
        OpeningKind::Door(angle) | OpeningKind::GlassDoor(angle) => {
            let hinge = point(wall, from + 0.02, wall.thickness * 0.5, 0.0);
            let width = to - from - 0.05;
            let leaf = Solid::between(Vector3::new(0.0, -0.02, 0.01), Vector3::new(width, 0.02, head - 0.03));
            let (x, z) = (width - 0.07, 1.05);
            let handle = Solid::rod(Vector3::new(x, -0.07, z), Vector3::new(x, 0.07, z), 0.012);
            // A wall along y has its hinge axis turned by a quarter, and opens to the other side.
            let turn = if wall.axis == 0 { angle } else { std::f32::consts::FRAC_PI_2 - angle };
            let glass = matches!(kind, OpeningKind::GlassDoor(_));
            let leaf = if glass { leaf.of(Material::Glass) } else { leaf };
            solids.extend([leaf, handle].map(|solid| solid.moved(&yaw(turn), &hinge)));
        }
        OpeningKind::Passage | OpeningKind::Hole => {}
    }
    solids
}

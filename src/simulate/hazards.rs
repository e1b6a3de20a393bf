//! What makes real scans disagree about free space: glass, mirrors, thin structure, dark surfaces. Used by the building, which
//! puts them in on top of what its plan says, so that a building without hazards is the same as it would be without this file.

use nalgebra::Vector3;

use super::draw::Draw;
use super::furniture::yaw;
use super::openings::{Doorway, Opening, OpeningKind};
use super::plan::{Plan, Room, RoomKind, Wall};
use super::solid::{Material, Solid};
use super::walls::part;
use crate::control::Seed;

/// How much of each hazard a building has: 0 is what every building has (some windows have panes), 1 is as much as there can be.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Hazards {
    /// Share of the inner walls and of the open doors that are of glass. With any, all windows have panes, there is something to see
    /// behind them, and panes also reflect: ghosts appear behind them.
    pub glass: f32,
    /// Share of the rooms with a mirror on a wall.
    pub mirrors: f32,
    /// Share of the windows with blinds, and of the rooms with cables, poles and railings.
    pub thin: f32,
    /// Share of the furniture that returns few rays.
    pub dark: f32,
}

impl Hazards {
    /// The first hazard whose share is not one, with its share.
    pub(super) fn first_wrong(&self) -> Option<(&'static str, f32)> {
        [
            ("glass", self.glass),
            ("mirrors", self.mirrors),
            ("thin structure", self.thin),
            ("dark surfaces", self.dark),
        ]
        .into_iter()
        .find(|(_, share)| !(0.0..=1.0).contains(share))
    }

    /// Share of the rays at a pane that are reflected.
    pub(super) fn ghosts(&self) -> f32 {
        if self.glass > 0.0 { 0.06 } else { 0.0 }
    }
}

/// Slats of a blind are this far apart and this thick, metres.
const SLATS: (f32, f32) = (0.06, 0.004);
/// Most of a wall that one mirror covers, metres.
const MIRROR: [f32; 2] = [0.6, 1.6];

/// Makes inner walls, doors and windows of a plan glass.
pub(super) fn glaze(plan: &mut Plan, hazards: &Hazards, seed: Seed) {
    if hazards.glass <= 0.0 {
        return;
    }
    let doorways = plan.doorways.clone();
    for (index, wall) in plan.walls.iter_mut().enumerate() {
        let mut draw = Draw::new(seed.derive("simulate.glaze", index as u128));
        let inner = doorways.iter().any(|doorway| belongs(doorway, wall));
        wall.glazed = inner && draw.chance(hazards.glass);
        for opening in &mut wall.openings {
            opening.kind = match opening.kind {
                OpeningKind::Hole => OpeningKind::Pane,
                OpeningKind::Door(angle) if draw.chance(hazards.glass) => OpeningKind::GlassDoor(angle),
                kind => kind,
            };
        }
    }
}

/// Whether a doorway leads through a wall.
fn belongs(doorway: &Doorway, wall: &Wall) -> bool {
    doorway.axis == wall.axis && (doorway.centre[1 - wall.axis] - wall.at).abs() < 1e-3
}

/// Mirrors, blinds, cables, poles and railings, and what stands outside of windows.
pub(super) fn hazardous(plan: &Plan, hazards: &Hazards, seed: Seed) -> Vec<Solid> {
    let mut solids = Vec::new();
    if hazards.glass > 0.0 {
        solids.extend(outside(plan, &mut Draw::new(seed.derive("simulate.outside", 0))));
    }
    for (index, room) in plan.rooms.iter().enumerate() {
        // Copies of a room have the same hazards in it.
        let subject = if room.identity == u64::MAX { u128::from(u64::MAX) } else { index as u128 };
        let mut draw = Draw::new(seed.derive("simulate.hazards", subject));
        let mut own = Vec::new();
        let half = room.size().map(|edge| edge * 0.5);
        if draw.chance(hazards.mirrors) {
            own.push(mirror(half, &mut draw));
        }
        if draw.chance(hazards.thin) {
            own.extend(thin_in_room(room, half, &mut draw));
        }
        let ([x, y], turn) = (room.centre(), if room.turned { std::f32::consts::PI } else { 0.0 });
        solids.extend(own.iter().map(|solid| solid.moved(&yaw(turn), &Vector3::new(x, y, 0.0))));
    }
    for (index, wall) in plan.walls.iter().enumerate() {
        for (number, opening) in wall.openings.iter().enumerate() {
            let subject = ((index as u128) << 32) | number as u128;
            let mut draw = Draw::new(seed.derive("simulate.blinds", subject));
            if opening.sill > 0.0 && draw.chance(hazards.thin) {
                solids.extend(blind(wall, opening, &mut draw));
            }
        }
    }
    solids
}

/// A mirror on the wall at the room's own -x or +x side.
fn mirror(half: [f32; 2], draw: &mut Draw) -> Solid {
    let side = draw.pick([-1.0, 1.0]);
    let (width, height) =
        (draw.between(MIRROR[0], MIRROR[1]) * 0.5, draw.between(MIRROR[0], MIRROR[1]) * 0.5);
    let (y, z) = (draw.between(-0.6, 0.6) * half[1], draw.between(1.1, 1.5));
    let x = side * (half[0] - 0.012);
    Solid::between(
        Vector3::new(x - 0.01, y - width, z - height),
        Vector3::new(x + 0.01, y + width, z + height),
    )
    .of(Material::Mirror)
}

/// Hanging cables, a pole from floor to ceiling, and in wide or long rooms a railing, in the room's own frame.
fn thin_in_room(room: &Room, half: [f32; 2], draw: &mut Draw) -> Vec<Solid> {
    let mut solids = Vec::new();
    let place = |draw: &mut Draw| half.map(|half| draw.between(-0.85, 0.85) * half);
    for _ in 0..draw.count(2, 5) {
        let ([x0, y0], [x1, y1]) = (place(draw), place(draw));
        let z = room.height - draw.between(0.05, 0.5);
        solids.push(Solid::rod(Vector3::new(x0, y0, z), Vector3::new(x1, y1, z), draw.between(0.004, 0.012)));
        solids.push(Solid::rod(Vector3::new(x0, y0, z), Vector3::new(x0, y0, room.height), 0.006));
    }
    for _ in 0..draw.count(1, 3) {
        let [x, y] = place(draw);
        solids.push(Solid::rod(
            Vector3::new(x, y, 0.0),
            Vector3::new(x, y, room.height),
            draw.between(0.015, 0.03),
        ));
    }
    if room.kind != RoomKind::Passage {
        let (sign, run) = (draw.pick([-1.0, 1.0]), half[0] * draw.between(0.4, 0.8));
        solids.extend(railing(-run, run, sign * half[1] * draw.between(0.35, 0.6)));
    }
    solids
}

/// A railing along x: bars of 12 mm a hand apart under a rail.
fn railing(from: f32, to: f32, y: f32) -> Vec<Solid> {
    let mut solids = vec![
        Solid::rod(Vector3::new(from, y, 1.0), Vector3::new(to, y, 1.0), 0.02),
        Solid::rod(Vector3::new(from, y, 0.1), Vector3::new(to, y, 0.1), 0.01),
    ];
    let bars = ((to - from) / 0.12).ceil().max(1.0) as usize;
    solids.extend((0..=bars).map(|i| {
        let x = from + (to - from) * i as f32 / bars as f32;
        Solid::rod(Vector3::new(x, y, 0.0), Vector3::new(x, y, 1.0), 0.006)
    }));
    solids
}

/// The slats of a blind in a window, from its head down.
fn blind(wall: &Wall, opening: &Opening, draw: &mut Draw) -> Vec<Solid> {
    let low = opening.sill + draw.between(0.0, 0.6) * (opening.head - opening.sill);
    let count = ((opening.head - low) / SLATS.0) as usize;
    let width = (opening.from + 0.02, opening.to - 0.02);
    (0..count)
        .map(|i| {
            let z = opening.head - SLATS.0 * (i as f32 + 0.5);
            part(wall, width, 0.02, (z, z + SLATS.1))
        })
        .collect()
}

/// Ground, hedges, poles and the front of another house around the building, a few metres away.
fn outside(plan: &Plan, draw: &mut Draw) -> Vec<Solid> {
    let low: [f32; 2] =
        [0, 1].map(|k| plan.rooms.iter().map(|room| room.low[k]).fold(f32::INFINITY, f32::min));
    let high: [f32; 2] =
        [0, 1].map(|k| plan.rooms.iter().map(|room| room.high[k]).fold(f32::NEG_INFINITY, f32::max));
    let reach = 14.0;
    let mut solids = vec![Solid::between(
        Vector3::new(low[0] - reach, low[1] - reach, -0.5),
        Vector3::new(high[0] + reach, high[1] + reach, -0.3),
    )];
    for side in 0..4 {
        let (along, across) = (side % 2, 1 - side % 2);
        let outwards = if side < 2 { high[across] } else { low[across] };
        let sign = if side < 2 { 1.0 } else { -1.0 };
        let mut block = |along_range: (f32, f32), away: f32, deep: f32, tall: f32| {
            let (a, b) = (outwards + sign * away, outwards + sign * (away + deep));
            let corner = |u: f32, v: f32, z: f32| {
                if along == 0 { Vector3::new(u, v, z) } else { Vector3::new(v, u, z) }
            };
            solids.push(Solid::between(
                corner(along_range.0, a.min(b), -0.3),
                corner(along_range.1, a.max(b), tall),
            ));
        };
        let mut at = low[along] - 6.0;
        while at < high[along] + 6.0 {
            let width = draw.between(0.8, 3.5);
            match draw.count(0, 3) {
                0 => block(
                    (at, at + width),
                    draw.between(2.0, 5.0),
                    draw.between(0.5, 1.5),
                    draw.between(0.6, 1.8),
                ),
                1 => block((at, at + 0.12), draw.between(1.5, 5.0), 0.12, draw.between(3.0, 5.0)),
                2 => block((at, at + width), draw.between(8.0, 11.0), 1.0, draw.between(3.0, 7.0)),
                _ => {}
            }
            at += width + draw.between(0.3, 2.0);
        }
    }
    solids
}

/// Makes a share of the solids of a room return few rays.
pub(super) fn darken(solids: &mut [Solid], share: f32, draw: &mut Draw) {
    for solid in solids {
        if draw.chance(share) && solid.material == Material::Matte {
            solid.material = Material::Dark;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::building::{Building, BuildingOptions};

    fn count(building: &Building, material: Material) -> usize {
        building.scene.solids().iter().filter(|solid| solid.material == material).count()
    }

    #[test]
    fn hazards_come_on_top_of_the_same_building() {
        let usual = BuildingOptions::default();
        let plain = Building::new(&usual, Seed(3)).unwrap();
        let hazards = Hazards { glass: 0.6, mirrors: 1.0, thin: 1.0, dark: 0.4 };
        let harsh = Building::new(&BuildingOptions { hazards, ..usual }, Seed(3)).unwrap();
        assert_eq!(plain.rooms, harsh.rooms);
        assert_eq!(plain.doorways, harsh.doorways);
        assert_eq!(count(&harsh, Material::Mirror), harsh.rooms.len());
        for material in [Material::Glass, Material::Dark] {
            assert!(count(&harsh, material) > count(&plain, material) + 3, "{material:?}");
        }
        let thin = |building: &Building| {
            let is_thin = |solid: &&Solid| {
                let (low, high) = solid.bounds();
                let mut size: [f32; 3] = (high - low).into();
                size.sort_by(f32::total_cmp);
                size[1] < 0.05 && size[2] > 0.8
            };
            building.scene.solids().iter().filter(is_thin).count()
        };
        assert!(thin(&harsh) > thin(&plain) + 50, "{} and {}", thin(&harsh), thin(&plain));
    }

    #[test]
    fn a_share_that_is_none_is_told() {
        assert_eq!(Hazards::default().first_wrong(), None);
        let wrong = Hazards { thin: 1.5, ..Hazards::default() };
        assert_eq!(wrong.first_wrong(), Some(("thin structure", 1.5)));
        assert!(Hazards { glass: f32::NAN, ..Hazards::default() }.first_wrong().is_some());
    }
}

//! Puts furniture into a room: some pieces that its kind needs, others along the walls, others anywhere, then what
//! hangs on walls and ceilings. Nothing overlaps, and doors stay free. Used by the building.

use std::f32::consts::{FRAC_PI_2, PI};

use super::draw::Draw;
use super::furniture::{self as f, Piece};
use super::plan::{OpeningKind, Plan, Room, RoomKind};
use super::solid::Solid;
use crate::control::Seed;

/// An oriented rectangle on the floor, taken by something `top` metres high.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Footprint {
    pub centre: [f32; 2],
    pub half: [f32; 2],
    /// Turn about the vertical, radians.
    pub angle: f32,
    pub top: f32,
}

impl Footprint {
    /// Whether a circle touches the rectangle.
    pub(super) fn reaches(&self, [x, y]: [f32; 2], radius: f32) -> bool {
        let (sin, cos) = self.angle.sin_cos();
        let (dx, dy) = (x - self.centre[0], y - self.centre[1]);
        let outside = |own: f32, half: f32| (own.abs() - half).max(0.0);
        let (u, v) = (outside(cos * dx + sin * dy, self.half[0]), outside(cos * dy - sin * dx, self.half[1]));
        u.hypot(v) < radius.max(1e-6)
    }

    fn axes(&self) -> [[f32; 2]; 2] {
        let (sin, cos) = self.angle.sin_cos();
        [[cos, sin], [-sin, cos]]
    }

    /// Half the extent along a unit vector.
    fn reach_along(&self, [x, y]: [f32; 2]) -> f32 {
        let [u, v] = self.axes();
        self.half[0] * (u[0] * x + u[1] * y).abs() + self.half[1] * (v[0] * x + v[1] * y).abs()
    }

    /// Whether two rectangles come closer than `gap`: no axis of either separates them.
    fn overlaps(&self, other: &Self, gap: f32) -> bool {
        let (dx, dy) = (other.centre[0] - self.centre[0], other.centre[1] - self.centre[1]);
        self.axes().into_iter().chain(other.axes()).all(|axis| {
            let apart = (dx * axis[0] + dy * axis[1]).abs();
            apart < self.reach_along(axis) + other.reach_along(axis) + gap
        })
    }

    fn turned_into(&self, origin: [f32; 2], turn: f32) -> Self {
        let (sin, cos) = turn.sin_cos();
        let [x, y] = self.centre;
        Self {
            centre: [origin[0] + cos * x - sin * y, origin[1] + sin * x + cos * y],
            angle: self.angle + turn,
            ..*self
        }
    }
}

/// Places that are tried for one piece.
const TRIES: usize = 30;

type Maker = fn(&mut Draw) -> Piece;

/// What a kind of room contains.
struct Suite {
    /// Stand away from the walls, once each, before anything else.
    middle: &'static [Maker],
    /// Stand against walls, once each.
    needed: &'static [Maker],
    /// Stand against walls.
    walls: &'static [Maker],
    /// Stand anywhere, turned by any angle.
    free: &'static [Maker],
}

fn suite(kind: RoomKind) -> Suite {
    match kind {
        RoomKind::Office => Suite {
            middle: &[],
            needed: &[f::desk, f::desk, f::shelf],
            walls: &[
                f::desk,
                f::shelf,
                f::cabinet,
                f::drawers,
                f::wardrobe,
                f::plant,
                f::radiator,
                f::carton_stack,
            ],
            free: &[f::desk, f::plant, f::coffee_table, f::office_chair, f::bin, f::carton_stack],
        },
        RoomKind::Meeting => Suite {
            middle: &[f::long_table],
            needed: &[f::cabinet],
            walls: &[f::cabinet, f::shelf, f::plant, f::chair, f::radiator, f::drawers, f::floor_lamp],
            free: &[f::armchair, f::chair, f::plant, f::bin],
        },
        RoomKind::Living => Suite {
            middle: &[f::rug, f::coffee_table],
            needed: &[f::sofa, f::shelf],
            walls: &[
                f::sofa,
                f::shelf,
                f::cabinet,
                f::floor_lamp,
                f::plant,
                f::armchair,
                f::radiator,
                f::drawers,
            ],
            free: &[f::coffee_table, f::armchair, f::dining_table, f::rug, f::plant, f::armchair],
        },
        RoomKind::Kitchen => Suite {
            middle: &[f::dining_table],
            needed: &[f::kitchen_counter],
            walls: &[f::cabinet, f::shelf, f::bin, f::radiator, f::drawers, f::plant],
            free: &[f::dining_table, f::dining_table, f::chair, f::bin],
        },
        RoomKind::Bedroom => Suite {
            middle: &[],
            needed: &[f::bed, f::wardrobe],
            walls: &[f::drawers, f::shelf, f::chair, f::floor_lamp, f::desk, f::radiator, f::plant],
            free: &[f::rug, f::armchair, f::chair, f::carton_stack],
        },
        RoomKind::Storage => Suite {
            middle: &[f::rack],
            needed: &[f::rack, f::rack],
            walls: &[f::rack, f::rack, f::shelf, f::carton_stack, f::wardrobe, f::carton_stack],
            free: &[f::rack, f::carton_stack, f::carton_stack, f::bin, f::chair],
        },
        RoomKind::Passage => Suite {
            middle: &[],
            needed: &[],
            walls: &[
                f::bench,
                f::cabinet,
                f::plant,
                f::bin,
                f::radiator,
                f::carton_stack,
                f::chair,
                f::drawers,
            ],
            free: &[],
        },
        RoomKind::Hall => Suite {
            middle: &[],
            needed: &[],
            walls: &[f::bench, f::radiator, f::plant, f::cabinet, f::bench],
            free: &[f::plant, f::bin, f::chair],
        },
    }
}

/// A room in its own frame: origin in the middle of the floor, x and y along its edges.
struct Furnisher<'a> {
    room: &'a Room,
    half: [f32; 2],
    draw: Draw,
    solids: Vec<Solid>,
    taken: Vec<Footprint>,
    /// Kept free for walking: only things on walls and ceilings may be here.
    reserved: Vec<Footprint>,
    /// In front of windows, where nothing tall stands.
    windows: Vec<Footprint>,
}

/// The furniture of a room, and the footprints of what stands on its floor, in the world frame.
pub(super) fn furnish(room: &Room, plan: &Plan, density: f32, seed: Seed) -> (Vec<Solid>, Vec<Footprint>) {
    let draw = Draw::new(seed.derive("simulate.furniture", u128::from(room.identity)));
    let half = room.size().map(|edge| edge * 0.5);
    let mut furnisher = Furnisher {
        room,
        half,
        draw,
        solids: Vec::new(),
        taken: Vec::new(),
        reserved: Vec::new(),
        windows: Vec::new(),
    };
    furnisher.reserve_openings(plan);
    if density > 0.0 {
        furnisher.fill(density);
    }
    let (turn, centre) = (if room.turned { PI } else { 0.0 }, room.centre());
    let whole = Piece { solids: furnisher.solids, ..Piece::default() };
    let footprints = furnisher.taken.iter().map(|footprint| footprint.turned_into(centre, turn)).collect();
    (whole.placed([centre[0], centre[1], 0.0], turn), footprints)
}

impl Furnisher<'_> {
    fn reserve_openings(&mut self, plan: &Plan) {
        let sign = if self.room.turned { -1.0 } else { 1.0 };
        let centre = self.room.centre();
        for wall in &plan.walls {
            for opening in &wall.openings {
                let middle = (opening.from + opening.to) * 0.5;
                let [x, y] = if wall.axis == 0 { [middle, wall.at] } else { [wall.at, middle] };
                let own = [sign * (x - centre[0]), sign * (y - centre[1])];
                if (0..2).any(|k| own[k].abs() > self.half[k] + wall.thickness) {
                    continue;
                }
                let walked = matches!(
                    opening.kind,
                    OpeningKind::Passage | OpeningKind::Door(_) | OpeningKind::GlassDoor(_)
                );
                let (along, across) = ((opening.to - opening.from) * 0.5, if walked { 1.25 } else { 0.5 });
                let half = if wall.axis == 0 { [along, across] } else { [across, along] };
                let zone = Footprint { centre: own, half, angle: 0.0, top: opening.sill };
                if walked { self.reserved.push(zone) } else { self.windows.push(zone) }
            }
        }
    }

    fn fill(&mut self, density: f32) {
        let Suite { middle, needed, walls, free } = suite(self.room.kind);
        let [width, depth] = self.half.map(|half| 2.0 * half);
        if self.room.kind == RoomKind::Hall {
            self.fill_hall();
        }
        for make in middle {
            let piece = make(&mut self.draw);
            self.stand_anywhere(&piece);
        }
        for make in needed {
            let piece = make(&mut self.draw);
            self.stand_at_wall(&piece);
        }
        let free_count = (width * depth * 0.1 * density).round() as usize;
        for _ in 0..free_count {
            let Some(piece) = self.any_of(free) else { break };
            self.stand_anywhere(&piece);
        }
        for _ in 0..((width + depth) * density).round() as usize {
            let Some(piece) = self.any_of(walls) else { break };
            self.stand_at_wall(&piece);
        }
        self.hang(density);
    }

    fn any_of(&mut self, makers: &[Maker]) -> Option<Piece> {
        let index = self.draw.count(0, makers.len().saturating_sub(1));
        makers.get(index).map(|make| make(&mut self.draw))
    }

    /// Pillars and tables that are the same after half a turn.
    fn fill_hall(&mut self) {
        let [x, y] = self.half;
        let size = self.draw.between(0.4, 0.6);
        for (px, py) in [(0.55, 0.45), (0.0, 0.45), (-0.55, 0.45)] {
            for sign in [1.0, -1.0] {
                let mut pillar =
                    Piece { half: [size * 0.5; 2], height: self.room.height, ..Piece::default() };
                pillar.solids.push(Solid::between(
                    [-size * 0.5, -size * 0.5, 0.0].into(),
                    [size * 0.5, size * 0.5, self.room.height].into(),
                ));
                self.try_place(&pillar, [sign * px * x, sign * py * y], 0.0, 0.0);
            }
        }
        for _ in 0..14 {
            let piece = f::long_table(&mut self.draw);
            let at = [self.draw.between(-0.8, 0.8) * x, self.draw.between(0.05, 0.75) * y];
            let angle = self.draw.between(-0.3, 0.3);
            if self.try_place(&piece, at, angle, 0.4) {
                self.try_place(&piece, at.map(|c| -c), angle + PI, 0.4);
            }
        }
    }

    /// Puts a piece where nothing else is, or says that something is.
    fn try_place(&mut self, piece: &Piece, at: [f32; 2], angle: f32, gap: f32) -> bool {
        let footprint = Footprint { centre: at, half: piece.half, angle, top: piece.height };
        let inside = (0..2).all(|k| {
            let axis = if k == 0 { [1.0, 0.0] } else { [0.0, 1.0] };
            at[k].abs() + footprint.reach_along(axis) < self.half[k]
        });
        let flat = piece.height < 0.03;
        let blocked = self.taken.iter().any(|other| other.overlaps(&footprint, gap))
            || (!flat && self.reserved.iter().any(|zone| zone.overlaps(&footprint, 0.0)))
            || self
                .windows
                .iter()
                .any(|zone| piece.height > zone.top + 0.1 && zone.overlaps(&footprint, 0.0));
        if !inside || blocked {
            return false;
        }
        self.solids.extend(piece.placed([at[0], at[1], 0.0], angle));
        if !flat {
            self.taken.push(footprint);
        }
        true
    }

    /// Tries places with the back to a wall.
    fn stand_at_wall(&mut self, piece: &Piece) {
        if self.room.kind == RoomKind::Passage && piece.half[1] > 0.3 {
            return;
        }
        for _ in 0..TRIES {
            let (side, along) = self.draw_side(piece.half[0]);
            let skew = if self.draw.chance(0.25) {
                self.draw.between(-0.25, 0.25)
            } else {
                self.draw.between(-0.03, 0.03)
            };
            let lean = skew.abs().sin() * piece.half[0] + skew.cos() * piece.half[1];
            let away = lean + self.draw.between(0.015, 0.08);
            let (at, angle) = self.at_wall(side, along, away);
            if self.try_place(piece, at, angle + skew, 0.04) {
                return;
            }
        }
    }

    /// Tries places away from the walls.
    fn stand_anywhere(&mut self, piece: &Piece) {
        for _ in 0..TRIES {
            let at = self.half.map(|half| self.draw.between(-half, half));
            let angle =
                if self.draw.chance(0.4) { self.draw.pick([0.0, FRAC_PI_2]) } else { self.draw.angle() };
            if self.try_place(piece, at, angle, 0.45) {
                return;
            }
        }
    }

    /// A side (0: -y, 1: +x, 2: +y, 3: -x) and a place along it for something with half a width.
    fn draw_side(&mut self, half_width: f32) -> (usize, f32) {
        let longer = usize::from(self.half[1] > self.half[0]);
        let share = self.half[longer] / (self.half[0] + self.half[1]);
        let along_x = self.draw.chance(share) == (longer == 0);
        let side = if along_x { self.draw.pick([0, 2]) } else { self.draw.pick([1, 3]) };
        let reach = (self.half[side % 2] - half_width - 0.03).max(0.0);
        (side, self.draw.between(-reach, reach))
    }

    /// The place `away` from a side, and the turn that puts a piece's back there.
    fn at_wall(&self, side: usize, along: f32, away: f32) -> ([f32; 2], f32) {
        let [x, y] = self.half;
        match side {
            0 => ([along, away - y], PI),
            1 => ([x - away, along], -FRAC_PI_2),
            2 => ([along, y - away], 0.0),
            _ => ([away - x, along], FRAC_PI_2),
        }
    }

    /// Pictures, boards and pipes on the walls; lamps and pipes on the ceiling.
    fn hang(&mut self, density: f32) {
        let [width, depth] = self.half.map(|half| 2.0 * half);
        let mut hung: Vec<Footprint> = Vec::new();
        for _ in 0..((width + depth) * 0.7 * density).round() as usize {
            let kind = self.draw.count(0, 4);
            let piece = match kind {
                0 => f::wall_board(&mut self.draw),
                1 => f::wall_pipe(&mut self.draw, self.room.height),
                _ => f::picture(&mut self.draw),
            };
            let (side, along) = self.draw_side(piece.half[0]);
            let (at, angle) = self.at_wall(side, along, 0.0);
            let footprint = Footprint { centre: at, half: [piece.half[0] + 0.05, 0.1], angle, top: 0.0 };
            let z = if kind == 1 { 0.0 } else { self.draw.between(1.35, 1.75) };
            let openings = self.reserved.iter().chain(&self.windows).chain(&hung);
            if openings.into_iter().all(|other| !other.overlaps(&footprint, 0.05)) {
                self.solids.extend(piece.placed([at[0], at[1], z], angle));
                hung.push(footprint);
            }
        }
        let height = self.room.height;
        let turn = self.draw.pick([0.0, FRAC_PI_2])
            + if self.draw.chance(0.2) { self.draw.between(-0.5, 0.5) } else { 0.0 };
        let lamp = f::ceiling_lamp(&mut self.draw);
        let (columns, rows) = ((width / 2.8).ceil() as usize, (depth / 2.8).ceil() as usize);
        for i in 0..columns * rows {
            let x = ((i % columns) as f32 + 0.5) / columns as f32 * width - self.half[0];
            let y = ((i / columns) as f32 + 0.5) / rows as f32 * depth - self.half[1];
            if self.draw.chance(0.75) {
                let at = [x + self.draw.between(-0.3, 0.3), y + self.draw.between(-0.3, 0.3), height];
                self.solids.extend(lamp.placed(at, turn));
            }
        }
        for _ in 0..self.draw.count(0, 2) {
            let axis = self.draw.count(0, 1);
            let pipe = f::ceiling_pipe(&mut self.draw, 2.0 * self.half[axis]);
            let aside = self.draw.between(-0.9, 0.9) * self.half[1 - axis];
            let at = if axis == 0 { [0.0, aside, height] } else { [aside, 0.0, height] };
            self.solids.extend(pipe.placed(at, if axis == 0 { 0.0 } else { FRAC_PI_2 }));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn footprints_overlap_exactly_when_no_axis_separates_them() {
        let a = Footprint { centre: [0.0; 2], half: [1.0, 0.5], angle: 0.0, top: 1.0 };
        let b =
            Footprint { centre: [1.9, 0.0], half: [0.8, 0.8], angle: std::f32::consts::FRAC_PI_4, top: 1.0 };
        assert!(a.overlaps(&b, 0.0), "the corner of b reaches 1.13 m towards a");
        assert!(!a.overlaps(&Footprint { centre: [2.2, 0.0], ..b }, 0.0));
        assert!(a.overlaps(&Footprint { centre: [2.2, 0.0], ..b }, 0.1));
        assert!(a.reaches([1.3, 0.0], 0.4) && !a.reaches([1.3, 0.9], 0.4));
    }
}

//! Puts furniture into a room: some pieces that its kind needs, others along the walls, others anywhere, then what
//! hangs on walls and ceilings. Nothing overlaps, and doors stay free. Used by the building.

use std::f32::consts::{FRAC_PI_2, PI};

use super::draw::Draw;
use super::footprint::Footprint;
use super::furniture::{self as f, Piece};
use super::openings::OpeningKind;
use super::plan::{Plan, Room, RoomKind};
use super::solid::Solid;
use super::suites::{Maker, Suite, suite};
use crate::control::Seed;

/// Places that are tried for one piece.
const TRIES: usize = 30;
/// Between pieces at a wall, metres.
const GAP_AT_WALL: f32 = 0.04;
/// Around pieces that stand anywhere, metres.
const GAP_ANYWHERE: f32 = 0.45;

/// Furniture in the world frame.
#[derive(Debug, Clone, Default)]
pub(super) struct Furniture {
    pub solids: Vec<Solid>,
    /// Of what stands on the floor.
    pub footprints: Vec<Footprint>,
}

/// What keeps a piece where it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    /// The building, or its weight.
    Fixed,
    /// Nothing, but its back belongs to a wall.
    AtWall,
    /// Nothing.
    Free,
}

/// A piece on the floor of a room.
struct Standing {
    piece: Piece,
    footprint: Footprint,
    place: Place,
}

impl Standing {
    /// Whether one can walk and put things on it.
    fn is_flat(&self) -> bool {
        is_flat(&self.piece)
    }
}

fn is_flat(piece: &Piece) -> bool {
    piece.height < 0.03
}

/// A room in its own frame: origin in the middle of the floor, x and y along its edges.
struct Furnisher<'a> {
    room: &'a Room,
    half: [f32; 2],
    draw: Draw,
    standing: Vec<Standing>,
    /// On walls and under the ceiling.
    hung: Vec<Solid>,
    /// Kept free for walking: only things on walls and ceilings may be here.
    reserved: Vec<Footprint>,
    /// In front of windows, where nothing tall stands.
    windows: Vec<Footprint>,
}

/// The furniture of a room; and how it stands later, when a share of what can be moved has been.
pub(super) fn furnish(room: &Room, plan: &Plan, density: f32, moved: f32, seed: Seed) -> [Furniture; 2] {
    let draw = |purpose| Draw::new(seed.derive(purpose, u128::from(room.identity)));
    let half = room.size().map(|edge| edge * 0.5);
    let mut furnisher = Furnisher {
        room,
        half,
        draw: draw("simulate.furniture"),
        standing: Vec::new(),
        hung: Vec::new(),
        reserved: Vec::new(),
        windows: Vec::new(),
    };
    furnisher.reserve_openings(plan);
    if density > 0.0 {
        furnisher.fill(density);
    }
    let before = furnisher.furniture();
    if moved > 0.0 {
        furnisher.draw = draw("simulate.moved");
        furnisher.rearrange(moved);
    }
    [before, furnisher.furniture()]
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
        match self.room.kind {
            RoomKind::Hall => self.fill_hall(),
            RoomKind::Warehouse => self.fill_warehouse(density),
            _ => {}
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
                self.try_place(&pillar, [sign * px * x, sign * py * y], 0.0, 0.0, Place::Fixed);
            }
        }
        for _ in 0..14 {
            let piece = f::long_table(&mut self.draw);
            let at = [self.draw.between(-0.8, 0.8) * x, self.draw.between(0.05, 0.75) * y];
            let angle = self.draw.between(-0.3, 0.3);
            if self.try_place(&piece, at, angle, 0.4, Place::Free) {
                self.try_place(&piece, at.map(|c| -c), angle + PI, 0.4, Place::Free);
            }
        }
    }

    /// Rows of pallet racks with aisles between, every bay like the next one but for what is stored in it.
    fn fill_warehouse(&mut self, density: f32) {
        let aisle = self.draw.between(2.4, 3.2);
        let levels = self.draw.count(3, 4);
        let (pitch, [width, depth]) = (f::PALLET_RACK_DEPTH + aisle, self.half.map(|half| 2.0 * half));
        // One walks around all rows.
        let bays = ((width - 2.0 * aisle) / f::PALLET_RACK_BAY).floor().max(1.0) as usize;
        let rows = ((depth - aisle) / pitch).floor().max(1.0) as usize;
        for row in 0..rows {
            let rack = f::pallet_rack(&mut self.draw, bays, levels, (0.7 * density).min(0.95));
            let y = (row as f32 + 0.5 - rows as f32 * 0.5) * pitch;
            self.try_place(&rack, [0.0, y], 0.0, 0.0, Place::Fixed);
        }
    }

    /// Puts a piece where nothing else is, or says that something is.
    fn try_place(&mut self, piece: &Piece, at: [f32; 2], angle: f32, gap: f32, place: Place) -> bool {
        let footprint = Footprint { centre: at, half: piece.half, angle, top: piece.height };
        let fits = self.fits(piece, &footprint, gap, None);
        if fits {
            self.standing.push(Standing { piece: piece.clone(), footprint, place });
        }
        fits
    }

    /// Whether a piece can stand somewhere, `moved` (the number of one that stands) being carried away.
    fn fits(&self, piece: &Piece, footprint: &Footprint, gap: f32, moved: Option<usize>) -> bool {
        let inside = (0..2).all(|k| {
            let axis = if k == 0 { [1.0, 0.0] } else { [0.0, 1.0] };
            footprint.centre[k].abs() + footprint.reach_along(axis) < self.half[k]
        });
        let taken = self
            .standing
            .iter()
            .enumerate()
            .filter(|(i, other)| Some(*i) != moved && !other.is_flat())
            .any(|(_, other)| other.footprint.overlaps(footprint, gap));
        inside
            && !taken
            && (is_flat(piece) || !self.reserved.iter().any(|zone| zone.overlaps(footprint, 0.0)))
            && !self.windows.iter().any(|zone| piece.height > zone.top + 0.1 && zone.overlaps(footprint, 0.0))
    }

    /// Tries places with the back to a wall.
    fn stand_at_wall(&mut self, piece: &Piece) {
        if self.room.kind == RoomKind::Passage && piece.half[1] > 0.3 {
            return;
        }
        for _ in 0..TRIES {
            let (at, angle) = self.draw_at_wall(piece.half);
            if self.try_place(piece, at, angle, GAP_AT_WALL, Place::AtWall) {
                return;
            }
        }
    }

    /// A place at a wall, and the turn that puts a piece's back there, more or less.
    fn draw_at_wall(&mut self, half: [f32; 2]) -> ([f32; 2], f32) {
        let (side, along) = self.draw_side(half[0]);
        let skew = if self.draw.chance(0.25) {
            self.draw.between(-0.25, 0.25)
        } else {
            self.draw.between(-0.03, 0.03)
        };
        let lean = skew.abs().sin() * half[0] + skew.cos() * half[1];
        let away = lean + self.draw.between(0.015, 0.08);
        let (at, angle) = self.at_wall(side, along, away);
        (at, angle + skew)
    }

    /// Tries places away from the walls.
    fn stand_anywhere(&mut self, piece: &Piece) {
        for _ in 0..TRIES {
            let (at, angle) = self.draw_anywhere();
            if self.try_place(piece, at, angle, GAP_ANYWHERE, Place::Free) {
                return;
            }
        }
    }

    /// A place in the room and a turn.
    fn draw_anywhere(&mut self) -> ([f32; 2], f32) {
        let at = self.half.map(|half| self.draw.between(-half, half));
        let angle = if self.draw.chance(0.4) { self.draw.pick([0.0, FRAC_PI_2]) } else { self.draw.angle() };
        (at, angle)
    }

    /// Moves a share of what can be moved to other places; what finds none stays.
    fn rearrange(&mut self, share: f32) {
        for i in 0..self.standing.len() {
            let place = self.standing[i].place;
            if place == Place::Fixed || !self.draw.chance(share) {
                continue;
            }
            let piece = self.standing[i].piece.clone();
            for _ in 0..TRIES {
                let ((at, angle), gap) = match place {
                    Place::AtWall => (self.draw_at_wall(piece.half), GAP_AT_WALL),
                    _ => (self.draw_anywhere(), GAP_ANYWHERE),
                };
                let footprint = Footprint { centre: at, angle, ..self.standing[i].footprint };
                if self.fits(&piece, &footprint, gap, Some(i)) {
                    self.standing[i].footprint = footprint;
                    break;
                }
            }
        }
    }

    /// What stands and hangs in the room now.
    fn furniture(&self) -> Furniture {
        let (turn, centre) = (if self.room.turned { PI } else { 0.0 }, self.room.centre());
        let standing = self.standing.iter().flat_map(|standing| {
            let Footprint { centre: [x, y], angle, .. } = standing.footprint;
            standing.piece.placed([x, y, 0.0], angle)
        });
        let solids = standing.chain(self.hung.iter().cloned()).collect();
        let whole = Piece { solids, ..Piece::default() };
        let footprints = self
            .standing
            .iter()
            .filter(|standing| !standing.is_flat())
            .map(|standing| standing.footprint.turned_into(centre, turn))
            .collect();
        Furniture { solids: whole.placed([centre[0], centre[1], 0.0], turn), footprints }
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
        let mut covered: Vec<Footprint> = Vec::new();
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
            let openings = self.reserved.iter().chain(&self.windows).chain(&covered);
            if openings.into_iter().all(|other| !other.overlaps(&footprint, 0.05)) {
                self.hung.extend(piece.placed([at[0], at[1], z], angle));
                covered.push(footprint);
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
                self.hung.extend(lamp.placed(at, turn));
            }
        }
        for _ in 0..self.draw.count(0, 2) {
            let axis = self.draw.count(0, 1);
            let pipe = f::ceiling_pipe(&mut self.draw, 2.0 * self.half[axis]);
            let aside = self.draw.between(-0.9, 0.9) * self.half[1 - axis];
            let at = if axis == 0 { [0.0, aside, height] } else { [aside, 0.0, height] };
            self.hung.extend(pipe.placed(at, if axis == 0 { 0.0 } else { FRAC_PI_2 }));
        }
    }
}

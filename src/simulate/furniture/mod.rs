//! Pieces of furniture, each made of many small solids and never twice the same.
//!
//! A piece stands in its own frame: origin on the floor in the middle of its footprint, z up, its back towards +y.
//! Pieces that hang have their origin where they are fixed. Metres. Used by [`super::furnish`], which places them.

mod decor;
mod seats;
mod storage;
mod tables;

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::draw::Draw;
use super::solid::{Material, Shape, Solid};

pub(super) use decor::{
    bin, carton_stack, ceiling_lamp, ceiling_pipe, floor_lamp, picture, plant, radiator, rug, wall_board,
    wall_pipe,
};
pub(super) use seats::{armchair, bed, bench, chair, office_chair, sofa};
pub(super) use storage::{
    PALLET_RACK_BAY, PALLET_RACK_DEPTH, cabinet, drawers, kitchen_counter, pallet, pallet_rack, rack, shelf,
    wardrobe,
};
pub(super) use tables::{coffee_table, desk, dining_table, long_table};

/// Turns about the vertical by an angle in radians.
pub(super) fn yaw(angle: f32) -> Matrix3<f32> {
    *Rotation3::from_axis_angle(&Vector3::z_axis(), angle).matrix()
}

/// A group of solids with a footprint.
#[derive(Debug, Clone, Default)]
pub(super) struct Piece {
    pub solids: Vec<Solid>,
    /// Half the width (x) and half the depth (y) of the footprint.
    pub half: [f32; 2],
    /// Top above the floor.
    pub height: f32,
}

impl Piece {
    fn new(width: f32, depth: f32, height: f32) -> Self {
        Self { solids: Vec::new(), half: [width * 0.5, depth * 0.5], height }
    }

    fn push(&mut self, solid: Solid) {
        self.solids.push(solid);
    }

    /// A cuboid given by the middle of its bottom and its edge lengths.
    fn block(&mut self, [x, y, z]: [f32; 3], [width, depth, height]: [f32; 3]) {
        self.push(block([x, y, z], [width, depth, height]));
    }

    /// A cylinder between the centres of its ends.
    fn rod(&mut self, from: [f32; 3], to: [f32; 3], radius: f32) {
        self.push(Solid::rod(Vector3::from(from), Vector3::from(to), radius));
    }

    fn ball(&mut self, centre: [f32; 3], radius: f32) {
        self.push(Solid::new(Shape::Ball { radius }, Vector3::from(centre)));
    }

    /// Sets another piece on or beside this one; the footprint stays.
    fn add(&mut self, piece: &Piece, at: [f32; 3], angle: f32) {
        self.solids.extend(piece.placed(at, angle));
    }

    /// The solids turned by `angle` (rad) about the vertical and moved to `at`.
    pub(super) fn placed(&self, at: [f32; 3], angle: f32) -> Vec<Solid> {
        let (rotation, translation) = (yaw(angle), Vector3::from(at));
        self.solids.iter().map(|solid| solid.moved(&rotation, &translation)).collect()
    }

    /// Four legs near the corners of the footprint, up to a height.
    fn legs(&mut self, draw: &mut Draw, height: f32) {
        let (round, thickness, inset) = (draw.chance(0.5), draw.between(0.03, 0.07), draw.between(0.04, 0.1));
        for (sx, sy) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
            let (x, y) = (sx * (self.half[0] - inset), sy * (self.half[1] - inset));
            if round {
                self.rod([x, y, 0.0], [x, y, height], thickness * 0.5);
            } else {
                self.block([x, y, 0.0], [thickness, thickness, height]);
            }
        }
    }
}

/// A cuboid given by the middle of its bottom and its edge lengths.
fn block([x, y, z]: [f32; 3], [width, depth, height]: [f32; 3]) -> Solid {
    let half = Vector3::new(width, depth, height) * 0.5;
    Solid::new(Shape::Cuboid(half), Vector3::new(x, y, z + half.z))
}

/// Small things scattered over a rectangle `2 half` wide at height `z`: cups, books, boxes, balls, bottles.
fn clutter(piece: &mut Piece, draw: &mut Draw, half: [f32; 2], z: f32, amount: usize) {
    for _ in 0..amount {
        let (x, y) = (draw.between(-half[0], half[0]), draw.between(-half[1], half[1]));
        let angle = draw.angle();
        let mut thing = Piece::default();
        match draw.count(0, 5) {
            0 => {
                let (radius, height) = (draw.between(0.03, 0.06), draw.between(0.08, 0.14));
                thing.rod([0.0; 3], [0.0, 0.0, height], radius);
            }
            1 => {
                let mut top = 0.0;
                for _ in 0..draw.count(1, 5) {
                    let thickness = draw.between(0.02, 0.05);
                    thing.block(
                        [draw.between(-0.02, 0.02), 0.0, top],
                        [0.16, draw.between(0.2, 0.26), thickness],
                    );
                    top += thickness;
                }
            }
            2 => {
                let size = [draw.between(0.08, 0.3), draw.between(0.08, 0.25), draw.between(0.06, 0.25)];
                thing.block([0.0; 3], size);
            }
            3 => {
                let radius = draw.between(0.05, 0.11);
                thing.ball([0.0, 0.0, radius], radius);
            }
            4 => {
                let height = draw.between(0.18, 0.24);
                thing.rod([0.0; 3], [0.0, 0.0, height], 0.04);
                thing.rod([0.0, 0.0, height], [0.0, 0.0, height + 0.08], 0.015);
            }
            _ => thing.block([0.0; 3], [0.33, 0.24, 0.02]),
        }
        piece.add(&thing, [x, y, z], angle);
    }
}

/// A flat screen, facing -y, on the foot of a stand at the origin.
fn screen(draw: &mut Draw, width: f32) -> Piece {
    let (height, lift, tilt) = (width * 0.57, draw.between(0.08, 0.18), draw.between(-0.15, 0.25));
    let mut piece = Piece::new(width, 0.2, lift + height);
    piece.block([0.0, 0.02, 0.0], [width * 0.4, 0.18, 0.015]);
    piece.rod([0.0, 0.04, 0.0], [0.0, 0.04, lift + height * 0.4], 0.02);
    let turn = *Rotation3::from_axis_angle(&Vector3::x_axis(), -tilt).matrix();
    let panel = block([0.0, 0.0, -height * 0.5], [width, 0.03, height]).of(Material::Dark);
    piece.push(panel.moved(&turn, &Vector3::new(0.0, 0.0, lift + height * 0.5)));
    piece
}

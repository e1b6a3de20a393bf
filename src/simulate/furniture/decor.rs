//! Lamps, plants, pictures, pipes and other things that make a room a particular room.

use nalgebra::{Rotation3, Vector3};

use super::{Piece, block};
use crate::simulate::draw::Draw;
use crate::simulate::solid::{Material, Shape, Solid};

/// A frustum of triangles about the vertical: a lamp shade or a pot. Open at both ends.
fn frustum(piece: &mut Piece, [x, y]: [f32; 2], bottom: (f32, f32), top: (f32, f32)) {
    const SIDES: usize = 14;
    let corner = |(radius, z): (f32, f32), i: usize| {
        let (sin, cos) = (std::f32::consts::TAU * (i % SIDES) as f32 / SIDES as f32).sin_cos();
        Vector3::new(x + radius * cos, y + radius * sin, z)
    };
    for i in 0..SIDES {
        let (near, far) = (corner(bottom, i), corner(top, i + 1));
        for between in [corner(bottom, i + 1), corner(top, i)] {
            let corners = [near, between, far];
            piece.push(Solid::new(Shape::Triangle(corners), Vector3::zeros()));
        }
    }
}

/// A standing lamp, upright or with a bent arm.
pub(in crate::simulate) fn floor_lamp(draw: &mut Draw) -> Piece {
    let (height, reach) =
        (draw.between(1.3, 1.8), if draw.chance(0.4) { draw.between(0.15, 0.3) } else { 0.0 });
    let mut piece = Piece::new(0.5, 0.5, height + 0.1);
    piece.rod([0.0; 3], [0.0, 0.0, 0.03], 0.15);
    piece.rod([0.0; 3], [0.0, 0.0, height - 0.1], 0.015);
    piece.rod([0.0, 0.0, height - 0.1], [reach, 0.0, height], 0.012);
    let (low, high) = (draw.between(0.15, 0.26), draw.between(0.06, 0.18));
    frustum(&mut piece, [reach, 0.0], (low, height - draw.between(0.15, 0.3)), (high, height + 0.08));
    piece
}

/// A pot with stems and many leaves: no two rays see it alike.
pub(in crate::simulate) fn plant(draw: &mut Draw) -> Piece {
    let (pot, rim, height) = (draw.between(0.18, 0.4), draw.between(0.12, 0.22), draw.between(0.6, 1.7));
    let mut piece = Piece::new(0.6, 0.6, height);
    frustum(&mut piece, [0.0; 2], (rim * 0.7, 0.0), (rim, pot));
    piece.rod([0.0, 0.0, pot - 0.06], [0.0, 0.0, pot - 0.04], rim * 0.95);
    for _ in 0..draw.count(4, 9) {
        let (lean, angle) = (draw.between(0.05, 0.28), draw.angle());
        let tip = [lean * angle.cos(), lean * angle.sin(), draw.between(0.6, 1.0) * height];
        piece.rod([0.0, 0.0, pot - 0.05], tip, 0.008);
        for _ in 0..draw.count(5, 9) {
            let along = draw.between(0.35, 1.0);
            let [x, y, z] = tip.map(|c| c * along);
            leaf(&mut piece, draw, Vector3::new(x, y, z.max(pot)));
        }
    }
    piece
}

fn leaf(piece: &mut Piece, draw: &mut Draw, stem: Vector3<f32>) {
    let (length, width) = (draw.between(0.1, 0.28), draw.between(0.04, 0.1));
    let turn = Rotation3::from_euler_angles(0.0, draw.between(-0.8, 0.6), draw.angle());
    let fold = draw.between(0.0, 0.03);
    let [middle, tip] = [Vector3::new(length * 0.5, 0.0, 0.0), Vector3::new(length, 0.0, -length * 0.2)];
    for side in [-1.0, 1.0] {
        let edge = middle + Vector3::new(0.0, side * width * 0.5, fold);
        let corners = [Vector3::zeros(), edge, tip].map(|corner| turn * corner);
        piece.push(Solid::new(Shape::Triangle(corners), stem));
    }
}

/// A waste bin or an umbrella stand.
pub(in crate::simulate) fn bin(draw: &mut Draw) -> Piece {
    let (radius, height) = (draw.between(0.12, 0.19), draw.between(0.28, 0.6));
    let mut piece = Piece::new(2.0 * radius, 2.0 * radius, height);
    frustum(&mut piece, [0.0; 2], (radius * 0.8, 0.0), (radius, height));
    piece.rod([0.0; 3], [0.0, 0.0, height * draw.between(0.05, 0.8)], radius * 0.8);
    piece
}

/// Cartons on top of each other, each turned a little more.
pub(in crate::simulate) fn carton_stack(draw: &mut Draw) -> Piece {
    let (mut top, mut piece) = (0.0, Piece::new(0.65, 0.65, 0.0));
    for _ in 0..draw.count(1, 4) {
        let size = [draw.between(0.3, 0.55), draw.between(0.25, 0.45), draw.between(0.15, 0.45)];
        let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), draw.between(-0.4, 0.4));
        let at = Vector3::new(draw.between(-0.05, 0.05), draw.between(-0.05, 0.05), top);
        piece.push(block([0.0; 3], size).moved(turn.matrix(), &at));
        top += size[2];
    }
    piece.height = top;
    piece
}

/// A rug: a centimetre of relief on the floor.
pub(in crate::simulate) fn rug(draw: &mut Draw) -> Piece {
    let (width, depth) = (draw.between(1.2, 2.4), draw.between(0.8, 1.7));
    let mut piece = Piece::new(width, depth, 0.012);
    piece.block([0.0; 3], [width, depth, 0.012]);
    piece
}

/// A ribbed radiator with its pipe and valve. Its back goes to a wall, below a window or not.
pub(in crate::simulate) fn radiator(draw: &mut Draw) -> Piece {
    let (width, height, lift) = (draw.between(0.6, 1.5), draw.between(0.4, 0.6), draw.between(0.1, 0.18));
    let mut piece = Piece::new(width + 0.1, 0.14, lift + height);
    let ribs = (width / 0.08) as usize;
    for i in 0..ribs {
        let x = (i as f32 + 0.5) / ribs as f32 * width - width * 0.5;
        piece.block([x, 0.0, lift], [0.05, 0.1, height]);
    }
    for z in [lift + 0.05, lift + height - 0.05] {
        piece.rod([-width * 0.5, 0.0, z], [width * 0.5, 0.0, z], 0.025);
    }
    let side = draw.pick([-1.0, 1.0]) * (width * 0.5 + 0.03);
    piece.rod([side, 0.0, 0.0], [side, 0.0, lift + 0.05], 0.012);
    piece.ball([side, -0.02, lift + 0.05], 0.03);
    piece
}

/// A framed picture. Origin: its middle, on the wall at +y.
pub(in crate::simulate) fn picture(draw: &mut Draw) -> Piece {
    let (width, height, frame) = (draw.between(0.3, 1.1), draw.between(0.3, 0.8), draw.between(0.02, 0.05));
    let mut piece = Piece::new(width, 0.05, height);
    piece.block([0.0, -0.01, -height * 0.5], [width, 0.02, height]);
    for side in [-1.0, 1.0] {
        piece.block([side * width * 0.5, -0.02, -height * 0.5], [frame, 0.04, height + frame]);
        piece.block([0.0, -0.02, side * height * 0.5 - frame * 0.5], [width, 0.04, frame]);
    }
    piece
}

/// A white board with its tray, a dark screen on an arm, or a notice board. Origin: its middle, on the wall at +y.
pub(in crate::simulate) fn wall_board(draw: &mut Draw) -> Piece {
    let (width, height) = (draw.between(1.0, 1.9), draw.between(0.6, 1.1));
    let mut piece = Piece::new(width, 0.12, height);
    if draw.chance(0.5) {
        piece.block([0.0, -0.02, -height * 0.5], [width, 0.03, height]);
        piece.block([0.0, -0.06, -height * 0.5], [width * 0.6, 0.09, 0.02]);
    } else {
        piece.block([0.0, -0.04, -0.1], [0.2, 0.08, 0.2]);
        piece.push(block([0.0, -0.1, -height * 0.5], [width, 0.05, height]).of(Material::Dark));
    }
    piece
}

/// A pipe up a wall, from floor to ceiling, with clamps. Origin: on the floor, at the wall.
pub(in crate::simulate) fn wall_pipe(draw: &mut Draw, room_height: f32) -> Piece {
    let radius = draw.between(0.015, 0.06);
    let mut piece = Piece::new(2.0 * radius, 0.2, room_height);
    let y = -radius - 0.03;
    piece.rod([0.0, y, 0.0], [0.0, y, room_height], radius);
    for _ in 0..draw.count(1, 3) {
        piece
            .block([0.0, y * 0.5, draw.between(0.3, room_height - 0.3)], [2.6 * radius, 0.06 + radius, 0.04]);
    }
    piece
}

/// A straight pipe or a square duct of a length along x. Origin: on the ceiling.
pub(in crate::simulate) fn ceiling_pipe(draw: &mut Draw, length: f32) -> Piece {
    let (size, drop) = (draw.between(0.04, 0.15), draw.between(0.08, 0.2));
    let mut piece = Piece::new(length, size, 0.0);
    if draw.chance(0.6) {
        piece.rod([-length * 0.5, 0.0, -drop], [length * 0.5, 0.0, -drop], size * 0.5);
    } else {
        piece.block([0.0, 0.0, -drop - size], [length, 1.6 * size, size]);
    }
    for i in 0..4 {
        let x = (i as f32 / 3.0 - 0.5) * (length - 0.3);
        piece.block([x, 0.0, -drop], [0.03, 0.03, drop]);
    }
    piece
}

/// A tube, a bowl on a cable, or a flat panel. Origin: on the ceiling.
pub(in crate::simulate) fn ceiling_lamp(draw: &mut Draw) -> Piece {
    let mut piece = Piece::new(1.2, 1.2, 0.0);
    match draw.count(0, 2) {
        0 => {
            piece.block([0.0, 0.0, -0.08], [draw.between(0.9, 1.5), 0.12, 0.08]);
            piece.rod([-0.6, 0.0, -0.1], [0.6, 0.0, -0.1], 0.02);
        }
        1 => {
            let drop = draw.between(0.25, 0.5);
            piece.rod([0.0, 0.0, 0.0], [0.0, 0.0, -drop], 0.01);
            frustum(&mut piece, [0.0; 2], (draw.between(0.18, 0.35), -drop - 0.15), (0.06, -drop + 0.05));
        }
        _ => piece.block([0.0, 0.0, -0.05], [draw.pick([0.6, 1.2]), 0.6, 0.05]),
    }
    piece
}

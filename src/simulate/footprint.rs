//! Rectangles on the floor, and whether they overlap. Used by what is put into rooms, and by whoever looks for a place to stand.

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
    pub(super) fn reach_along(&self, [x, y]: [f32; 2]) -> f32 {
        let [u, v] = self.axes();
        self.half[0] * (u[0] * x + u[1] * y).abs() + self.half[1] * (v[0] * x + v[1] * y).abs()
    }

    /// Whether two rectangles come closer than `gap`: no axis of either separates them.
    pub(super) fn overlaps(&self, other: &Self, gap: f32) -> bool {
        let (dx, dy) = (other.centre[0] - self.centre[0], other.centre[1] - self.centre[1]);
        self.axes().into_iter().chain(other.axes()).all(|axis| {
            let apart = (dx * axis[0] + dy * axis[1]).abs();
            apart < self.reach_along(axis) + other.reach_along(axis) + gap
        })
    }

    /// The same in the frame in which its own one lies at `origin`, turned by `turn` radians.
    pub(super) fn turned_into(&self, origin: [f32; 2], turn: f32) -> Self {
        let (sin, cos) = turn.sin_cos();
        let [x, y] = self.centre;
        Self {
            centre: [origin[0] + cos * x - sin * y, origin[1] + sin * x + cos * y],
            angle: self.angle + turn,
            ..*self
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

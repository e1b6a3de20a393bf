//! Where a picture is taken from.

use crate::geometry::Point;

/// An orthographic view of the upright frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct View {
    /// Unit vectors: to the right in the picture, up in the picture, and away from the viewer.
    axes: [[f32; 3]; 3],
}

impl View {
    /// From above.
    pub fn top() -> Self {
        Self { axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]] }
    }

    /// From the front right, 38 degrees above the horizon.
    pub fn oblique() -> Self {
        let (sin_turn, cos_turn) = 30f32.to_radians().sin_cos();
        let (sin_tilt, cos_tilt) = 38f32.to_radians().sin_cos();
        Self {
            axes: [
                [cos_turn, sin_turn, 0.0],
                [-sin_turn * sin_tilt, cos_turn * sin_tilt, cos_tilt],
                [-sin_turn * cos_tilt, cos_turn * cos_tilt, -sin_tilt],
            ],
        }
    }

    /// Metres to the right, up, and away.
    pub fn project(&self, at: &Point) -> [f32; 3] {
        self.axes.map(|axis| axis[0] * at[0] + axis[1] * at[1] + axis[2] * at[2])
    }
}

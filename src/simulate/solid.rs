//! The shapes of which scenes are made, and where a ray meets them. Used by the scene, which holds many of them.

use nalgebra::{Matrix3, Rotation3, Vector3};

/// What a surface does to a ray of light.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Material {
    /// Returns light like paint, wood or cloth.
    Matte,
    /// Returns little light: black plastic, screens. Some of its points are missing.
    Dark,
    /// Lets most rays pass, and returns the rest when hit squarely.
    Glass,
    /// Sends every ray on as light is reflected: what it meets then seems to lie behind the surface.
    Mirror,
}

/// A shape in its own frame, with its centre (a triangle: its reference point) at the origin. Metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// A cuboid, given by half its edge lengths.
    Cuboid(Vector3<f32>),
    /// A closed cylinder along z.
    Cylinder {
        /// Radius of the circle.
        radius: f32,
        /// Half the length along z.
        half_height: f32,
    },
    /// A ball.
    Ball {
        /// Its radius.
        radius: f32,
    },
    /// A triangle seen from both sides, given by its corners.
    Triangle([Vector3<f32>; 3]),
}

/// A half-line. `direction` has length one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Where it starts.
    pub origin: Vector3<f32>,
    /// Where it goes, a unit vector.
    pub direction: Vector3<f32>,
}

/// The point where a ray first meets a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Along the ray, metres.
    pub distance: f32,
    /// Of the surface, towards the ray's origin, a unit vector.
    pub normal: Vector3<f32>,
    /// Of the surface.
    pub material: Material,
    /// Red, green, blue of the surface.
    pub color: [u8; 3],
}

/// The colour of what nobody painted.
const UNPAINTED: [u8; 3] = [190, 186, 180];

/// A shape placed in the world: `x_world = rotation x_solid + centre`.
#[derive(Debug, Clone, PartialEq)]
pub struct Solid {
    /// What it is, in its own frame.
    pub shape: Shape,
    /// Axes of the solid in the world.
    pub rotation: Matrix3<f32>,
    /// Origin of the solid's frame in the world.
    pub centre: Vector3<f32>,
    /// Of its surface.
    pub material: Material,
    /// Red, green, blue of its surface.
    pub color: [u8; 3],
}

impl Solid {
    /// A matte shape with the world's axes.
    #[must_use]
    pub fn new(shape: Shape, centre: Vector3<f32>) -> Self {
        Self { shape, rotation: Matrix3::identity(), centre, material: Material::Matte, color: UNPAINTED }
    }

    /// A cuboid along the world's axes, between two opposite corners.
    #[must_use]
    pub fn between(low: Vector3<f32>, high: Vector3<f32>) -> Self {
        Self::new(Shape::Cuboid((high - low).abs() * 0.5), (low + high) * 0.5)
    }

    /// A cylinder between the centres of its two ends.
    #[must_use]
    pub fn rod(from: Vector3<f32>, to: Vector3<f32>, radius: f32) -> Self {
        let axis = to - from;
        let rotation = Rotation3::rotation_between(&Vector3::z(), &axis)
            .unwrap_or_else(|| Rotation3::from_axis_angle(&Vector3::x_axis(), std::f32::consts::PI));
        let shape = Shape::Cylinder { radius, half_height: axis.norm() * 0.5 };
        Self { rotation: *rotation.matrix(), ..Self::new(shape, (from + to) * 0.5) }
    }

    /// The same shape of another material.
    #[must_use]
    pub fn of(self, material: Material) -> Self {
        Self { material, ..self }
    }

    /// The same shape in another colour.
    #[must_use]
    pub fn painted(self, color: [u8; 3]) -> Self {
        Self { color, ..self }
    }

    /// Turned about the world's origin, then moved.
    #[must_use]
    pub fn moved(&self, rotation: &Matrix3<f32>, translation: &Vector3<f32>) -> Self {
        Self {
            rotation: rotation * self.rotation,
            centre: rotation * self.centre + translation,
            ..self.clone()
        }
    }

    /// The corners of the smallest box along the world's axes that holds the solid.
    #[must_use]
    pub fn bounds(&self) -> (Vector3<f32>, Vector3<f32>) {
        let reach = match self.shape {
            Shape::Cuboid(half) => self.rotation.abs() * half,
            Shape::Cylinder { radius, half_height } => {
                let axis = self.rotation.column(2);
                axis.map(|a| a.abs() * half_height + radius * (1.0 - a * a).max(0.0).sqrt())
            }
            Shape::Ball { radius } => Vector3::repeat(radius),
            Shape::Triangle(corners) => {
                let [a, b, c] = corners.map(|corner| self.rotation * corner + self.centre);
                return (a.inf(&b).inf(&c), a.sup(&b).sup(&c));
            }
        };
        (self.centre - reach, self.centre + reach)
    }

    /// Where a ray first meets the surface at a distance in `(near, far)`. From inside, that is where it leaves.
    #[must_use]
    pub fn meet(&self, ray: &Ray, near: f32, far: f32) -> Option<Hit> {
        let origin = self.rotation.tr_mul(&(ray.origin - self.centre));
        let direction = self.rotation.tr_mul(&ray.direction);
        let within = |distance: f32| distance > near && distance < far;
        let (distance, normal) = match self.shape {
            Shape::Cuboid(half) => meet_cuboid(&origin, &direction, &half, within),
            Shape::Cylinder { radius, half_height } => {
                meet_cylinder(&origin, &direction, radius, half_height, within)
            }
            Shape::Ball { radius } => meet_ball(&origin, &direction, radius, within),
            Shape::Triangle(corners) => meet_triangle(&origin, &direction, &corners, within),
        }?;
        let normal = self.rotation * normal;
        let normal = if normal.dot(&ray.direction) > 0.0 { -normal } else { normal };
        Some(Hit { distance, normal, material: self.material, color: self.color })
    }
}

type Met = Option<(f32, Vector3<f32>)>;

/// The slab method: a ray is inside the cuboid where it is between all three pairs of planes.
fn meet_cuboid(
    origin: &Vector3<f32>,
    direction: &Vector3<f32>,
    half: &Vector3<f32>,
    within: impl Fn(f32) -> bool,
) -> Met {
    let (mut enter, mut enter_axis) = (f32::NEG_INFINITY, 0);
    let (mut leave, mut leave_axis) = (f32::INFINITY, 0);
    for axis in 0..3 {
        if direction[axis] == 0.0 {
            if origin[axis].abs() > half[axis] {
                return None;
            }
            continue;
        }
        let inverse = direction[axis].recip();
        let (a, b) = ((-half[axis] - origin[axis]) * inverse, (half[axis] - origin[axis]) * inverse);
        if a.min(b) > enter {
            (enter, enter_axis) = (a.min(b), axis);
        }
        if a.max(b) < leave {
            (leave, leave_axis) = (a.max(b), axis);
        }
    }
    if enter > leave {
        return None;
    }
    [(enter, enter_axis), (leave, leave_axis)]
        .into_iter()
        .find(|(distance, _)| within(*distance))
        .map(|(distance, axis)| (distance, Vector3::ith(axis, 1.0)))
}

fn meet_cylinder(
    origin: &Vector3<f32>,
    direction: &Vector3<f32>,
    radius: f32,
    half_height: f32,
    within: impl Fn(f32) -> bool,
) -> Met {
    let mut best: Met = None;
    let mut offer = |distance: f32, normal: Vector3<f32>| {
        if within(distance) && best.is_none_or(|(nearest, _)| distance < nearest) {
            best = Some((distance, normal));
        }
    };
    let (o, d) = (origin.xy(), direction.xy());
    let a = d.norm_squared();
    if a > 1e-12 {
        // The nearest point of the ray to the axis, and half the chord: better conditioned than b^2 - 4ac.
        let middle = -o.dot(&d) / a;
        let chord = (radius * radius - (o + d * middle).norm_squared()) / a;
        if chord < 0.0 {
            return None;
        }
        for distance in [middle - chord.sqrt(), middle + chord.sqrt()] {
            let p = origin + direction * distance;
            if p.z.abs() <= half_height {
                offer(distance, Vector3::new(p.x, p.y, 0.0) / radius);
            }
        }
    }
    if direction.z != 0.0 {
        for end in [-half_height, half_height] {
            let distance = (end - origin.z) / direction.z;
            if (o + d * distance).norm_squared() <= radius * radius {
                offer(distance, Vector3::z());
            }
        }
    }
    best
}

fn meet_ball(
    origin: &Vector3<f32>,
    direction: &Vector3<f32>,
    radius: f32,
    within: impl Fn(f32) -> bool,
) -> Met {
    let middle = -origin.dot(direction);
    let chord = radius * radius - (origin + direction * middle).norm_squared();
    if chord < 0.0 {
        return None;
    }
    [middle - chord.sqrt(), middle + chord.sqrt()]
        .into_iter()
        .find(|distance| within(*distance))
        .map(|distance| (distance, (origin + direction * distance) / radius))
}

/// Möller and Trumbore: barycentric coordinates by Cramer's rule.
fn meet_triangle(
    origin: &Vector3<f32>,
    direction: &Vector3<f32>,
    [first, second, third]: &[Vector3<f32>; 3],
    within: impl Fn(f32) -> bool,
) -> Met {
    let (edge, other_edge) = (second - first, third - first);
    let across = direction.cross(&other_edge);
    let determinant = edge.dot(&across);
    if determinant.abs() < 1e-12 {
        return None;
    }
    let from_first = origin - first;
    let u = from_first.dot(&across) / determinant;
    let along = from_first.cross(&edge);
    let v = direction.dot(&along) / determinant;
    let distance = other_edge.dot(&along) / determinant;
    let inside = u >= 0.0 && v >= 0.0 && u + v <= 1.0 && within(distance);
    inside.then(|| (distance, edge.cross(&other_edge).normalize()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ray(origin: [f32; 3], direction: [f32; 3]) -> Ray {
        Ray { origin: Vector3::from(origin), direction: Vector3::from(direction).normalize() }
    }

    fn assert_hit(solid: &Solid, ray: &Ray, distance: f32, normal: [f32; 3]) {
        let hit = solid.meet(ray, 0.0, f32::INFINITY).unwrap();
        assert!((hit.distance - distance).abs() < 1e-5, "{} instead of {distance}", hit.distance);
        assert!((hit.normal - Vector3::from(normal)).norm() < 1e-5, "normal {}", hit.normal);
    }

    #[test]
    fn a_cuboid_is_met_on_its_near_face_and_left_on_its_far_face() {
        let cuboid = Solid::between(Vector3::new(1.0, -1.0, -1.0), Vector3::new(3.0, 1.0, 1.0));
        assert_hit(&cuboid, &ray([0.0; 3], [1.0, 0.0, 0.0]), 1.0, [-1.0, 0.0, 0.0]);
        assert_hit(&cuboid, &ray([2.0, 0.0, 0.0], [1.0, 0.0, 0.0]), 1.0, [-1.0, 0.0, 0.0]);
        assert_hit(&cuboid, &ray([0.0, 0.0, 0.0], [1.0, 0.5, 0.0]), 1.25f32.sqrt(), [-1.0, 0.0, 0.0]);
        assert_eq!(cuboid.meet(&ray([0.0, 2.0, 0.0], [1.0, 0.0, 0.0]), 0.0, 9.0), None);
    }

    #[test]
    fn a_turned_cuboid_is_met_on_its_edge_where_geometry_says() {
        let turn = *Rotation3::from_axis_angle(&Vector3::z_axis(), std::f32::consts::FRAC_PI_4).matrix();
        let cuboid = Solid::between(Vector3::repeat(-1.0), Vector3::repeat(1.0))
            .moved(&turn, &Vector3::new(5.0, 0.0, 0.0));
        let hit = cuboid.meet(&ray([0.0, 1e-4, 0.0], [1.0, 0.0, 0.0]), 0.0, 9.0).unwrap();
        assert!((hit.distance - (5.0 - 2f32.sqrt())).abs() < 1e-3);
    }

    #[test]
    fn a_lying_cylinder_is_met_on_its_side_and_on_its_ends() {
        let rod = Solid::rod(Vector3::new(2.0, -1.0, 0.0), Vector3::new(2.0, 1.0, 0.0), 0.5);
        assert_hit(&rod, &ray([0.0; 3], [1.0, 0.0, 0.0]), 1.5, [-1.0, 0.0, 0.0]);
        assert_hit(&rod, &ray([2.2, -4.0, 0.1], [0.0, 1.0, 0.0]), 3.0, [0.0, -1.0, 0.0]);
        assert_eq!(rod.meet(&ray([0.0, 1.2, 0.0], [1.0, 0.0, 0.0]), 0.0, 9.0), None);
        let downwards = Solid::rod(Vector3::new(0.0, 0.0, 1.0), Vector3::zeros(), 0.5);
        assert_hit(&downwards, &ray([-2.0, 0.0, 0.5], [1.0, 0.0, 0.0]), 1.5, [-1.0, 0.0, 0.0]);
    }

    #[test]
    fn a_ball_and_a_triangle_are_met_where_geometry_says() {
        let ball = Solid::new(Shape::Ball { radius: 1.0 }, Vector3::new(0.0, 0.0, 4.0));
        assert_hit(&ball, &ray([0.0; 3], [0.0, 0.0, 1.0]), 3.0, [0.0, 0.0, -1.0]);
        let corners = [Vector3::zeros(), Vector3::x(), Vector3::y()];
        let triangle = Solid::new(Shape::Triangle(corners), Vector3::new(0.0, 0.0, 2.0));
        assert_hit(&triangle, &ray([0.2, 0.2, 0.0], [0.0, 0.0, 1.0]), 2.0, [0.0, 0.0, -1.0]);
        assert_eq!(triangle.meet(&ray([0.8, 0.8, 0.0], [0.0, 0.0, 1.0]), 0.0, 9.0), None);
    }

    #[test]
    fn bounds_hold_every_point_where_rays_meet_the_solid() {
        let turn = *Rotation3::from_euler_angles(0.3, 1.1, -0.7).matrix();
        for shape in [
            Shape::Cuboid(Vector3::new(0.3, 0.5, 0.9)),
            Shape::Cylinder { radius: 0.4, half_height: 0.8 },
            Shape::Ball { radius: 0.6 },
        ] {
            let solid = Solid::new(shape, Vector3::zeros()).moved(&turn, &Vector3::new(0.0, 0.0, 3.0));
            let (low, high) = solid.bounds();
            let mut hits = 0;
            for i in 0..400 {
                let (x, y) = ((i % 20) as f32 / 40.0 - 0.25, (i / 20) as f32 / 40.0 - 0.25);
                let ray = ray([0.0; 3], [x, y, 1.0]);
                if let Some(hit) = solid.meet(&ray, 0.0, 9.0) {
                    let p = ray.direction * hit.distance;
                    assert!((0..3).all(|k| p[k] > low[k] - 1e-5 && p[k] < high[k] + 1e-5));
                    hits += 1;
                }
            }
            assert!(hits > 50);
        }
    }
}

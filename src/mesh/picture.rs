//! Pictures of meshes, to be looked at: flat shaded triangles, nearer ones in front, no perspective. The same mesh gives the same bytes.

use crate::points::picture::encode;
use glam::{DMat3, DVec3};

/// The bytes of a PNG picture of `triangles` over `positions`, looked at along `sight`, with z upwards where that is possible.
///
/// Triangles seen from behind are red: a sound closed mesh shows none.
pub fn render(
    positions: &[DVec3],
    triangles: &[[u32; 3]],
    sight: DVec3,
    (width, height): (u32, u32),
) -> Vec<u8> {
    const LARGEST_SIDE_PX: u32 = 8192;
    let (width, height) = (
        width.clamp(1, LARGEST_SIDE_PX),
        height.clamp(1, LARGEST_SIDE_PX),
    );
    let axes = screen_axes(sight);
    let points: Vec<DVec3> = positions.iter().map(|p| axes * *p).collect();
    let mut canvas = Canvas {
        width: width as usize,
        height: height as usize,
        nearness: vec![f64::NEG_INFINITY; (width * height) as usize],
        pixels: vec![0xff; 3 * (width * height) as usize],
    };
    let (low, high) = super::curve::bounds(points.iter().copied());
    let extent = (high - low).truncate().max_element().max(f64::MIN_POSITIVE);
    let size = f64::from(width.min(height));
    let scale = 0.94 * size / extent;
    let middle = (low + high) / 2.0;
    let to_pixel = |p: DVec3| {
        let q = (p - middle) * scale;
        DVec3::new(
            0.5 * f64::from(width) + q.x,
            0.5 * f64::from(height) - q.y,
            q.z,
        )
    };
    for t in triangles {
        let [a, b, c] = t.map(|v| points[v as usize]);
        let normal = (b - a).cross(c - a).normalize_or_zero();
        canvas.triangle([a, b, c].map(to_pixel), colour(normal));
    }
    encode(&canvas.pixels, width, height)
}

/// Rows: right, up, and towards the eye.
fn screen_axes(sight: DVec3) -> DMat3 {
    let eye = (-sight).try_normalize().unwrap_or(DVec3::Z);
    let up = if eye.z.abs() > 0.99 {
        DVec3::Y
    } else {
        DVec3::Z
    };
    let right = up.cross(eye).normalize();
    DMat3::from_cols(right, eye.cross(right), eye).transpose()
}

/// Light from the upper left, towards the eye, and a little from all around.
fn colour(normal: DVec3) -> [u8; 3] {
    let light = DVec3::new(-0.4, 0.5, 0.77);
    let (base, normal) = if normal.z < 0.0 {
        (DVec3::new(213.0, 94.0, 0.0), -normal)
    } else {
        (DVec3::new(205.0, 212.0, 222.0), normal)
    };
    let brightness = 0.25 + 0.75 * normal.dot(light).max(0.0);
    (base * brightness).to_array().map(|x| x.min(255.0) as u8)
}

struct Canvas {
    width: usize,
    height: usize,
    nearness: Vec<f64>,
    pixels: Vec<u8>,
}

impl Canvas {
    fn triangle(&mut self, [a, b, c]: [DVec3; 3], colour: [u8; 3]) {
        let area = (b - a).truncate().perp_dot((c - a).truncate());
        if area == 0.0 || !area.is_finite() {
            return;
        }
        let low = a.min(b).min(c);
        let high = a.max(b).max(c);
        // A cast keeps within the range of its type.
        let rows =
            low.y.floor().max(0.0) as usize..(high.y.ceil().max(0.0) as usize).min(self.height);
        for row in rows {
            let columns =
                low.x.floor().max(0.0) as usize..(high.x.ceil().max(0.0) as usize).min(self.width);
            for column in columns {
                let p = DVec3::new(column as f64 + 0.5, row as f64 + 0.5, 0.0).truncate();
                let wb = (p - a.truncate()).perp_dot((c - a).truncate()) / area;
                let wc = (b - a).truncate().perp_dot(p - a.truncate()) / area;
                if wb < 0.0 || wc < 0.0 || wb + wc > 1.0 {
                    continue;
                }
                let z = a.z + wb * (b.z - a.z) + wc * (c.z - a.z);
                let pixel = row * self.width + column;
                if z > self.nearness[pixel] {
                    self.nearness[pixel] = z;
                    self.pixels[3 * pixel..3 * pixel + 3].copy_from_slice(&colour);
                }
            }
        }
    }
}

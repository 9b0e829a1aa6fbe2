//! Pictures of clouds, to be looked at: every point a disc of its colour, nearer ones in front, steps in depth darkened.
//!
//! The same points give the same bytes.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{Matrix3, SymmetricEigen};

/// Colour of a point of no class: light grey.
pub const NONE: [u8; 3] = [0xb8, 0xb8, 0xb8];
/// Colour of a point of an edge: vermilion. This and the next two can be told apart by the colour-blind
/// (Okabe and Ito, Color universal design, 2008).
pub const EDGE: [u8; 3] = [0xd5, 0x5e, 0x00];
/// Colour of a corner: blue.
pub const CORNER: [u8; 3] = [0x00, 0x72, 0xb2];
/// Colour of a boundary: bluish green.
pub const BOUNDARY: [u8; 3] = [0x00, 0x9e, 0x73];

/// Where a cloud is looked at from; the picture has no perspective.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ViewDirection {
    /// Lengthwise across the picture: a flat cloud from straight above, a solid one from an angle that shows three sides.
    Auto,
    /// Along this vector, from the eye into the scene, with z upwards where that is possible.
    Along(DVec3),
}

/// Most pixels along one side of a picture.
const LARGEST_SIDE_PX: u32 = 8192;
/// A cloud is flat where its thickness is below this share of its length (standard deviations).
const FLAT: f64 = 0.01;
/// Share of the picture left free on every side.
const MARGIN: f64 = 0.04;
const BACKGROUND: [u8; 3] = [0xff; 3];

/// The bytes of a PNG picture of N `positions` in N `colours`; colours that are missing are [`NONE`].
///
/// Positions that are not finite are left out; no positions give an empty picture. Sides are kept within 1 to 8192 pixels.
pub fn render(
    positions: &[DVec3],
    colours: &[[u8; 3]],
    view: ViewDirection,
    size_px: (u32, u32),
) -> Vec<u8> {
    let width = size_px.0.clamp(1, LARGEST_SIDE_PX);
    let height = size_px.1.clamp(1, LARGEST_SIDE_PX);
    let mut canvas = Canvas::new(width as usize, height as usize);
    let screen_from_world = screen_axes(positions, view);
    let points: Vec<DVec3> = positions.iter().map(|&p| screen_from_world * p).collect();
    if let Some(scale) = Scale::fit(&points, width, height) {
        for (index, &point) in points.iter().enumerate().filter(|(_, p)| p.is_finite()) {
            canvas.disc(scale.pixel(point), scale.radius_px, index);
        }
    }
    encode(&canvas.shaded(colours), width, height)
}

/// Rows: right, up, and towards the eye.
fn screen_axes(positions: &[DVec3], view: ViewDirection) -> DMat3 {
    let (right, towards_eye) = match view {
        ViewDirection::Along(sight) => {
            let towards_eye = (-sight).try_normalize().unwrap_or(DVec3::Z);
            let up = if towards_eye.z.abs() > 0.99 {
                DVec3::Y
            } else {
                DVec3::Z
            };
            (up.cross(towards_eye).normalize(), towards_eye)
        }
        ViewDirection::Auto => automatic_axes(positions),
    };
    let up = towards_eye.cross(right);
    DMat3::from_cols(right, up, towards_eye).transpose()
}

/// Right and towards the eye, from the principal axes of the cloud.
fn automatic_axes(positions: &[DVec3]) -> (DVec3, DVec3) {
    let finite = || positions.iter().filter(|p| p.is_finite());
    let count = finite().count().max(1) as f64;
    let mean = finite().sum::<DVec3>() / count;
    let mut covariance = Matrix3::zeros();
    for p in finite() {
        let d = nalgebra::Vector3::from((*p - mean).to_array());
        covariance += d * d.transpose() / count;
    }
    if covariance.iter().any(|v: &f64| !v.is_finite()) {
        return (DVec3::X, DVec3::Z);
    }
    let eigen = SymmetricEigen::new(covariance);
    let mut order = [0, 1, 2];
    order.sort_by(|&a: &usize, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    // The sign of an eigenvector is arbitrary: the largest component is made positive.
    let [long, middle, thin] = order.map(|i| {
        let axis = DVec3::from_array(eigen.eigenvectors.column(i).into_owned().into());
        let largest = axis.to_array()[axis.abs().max_position()];
        axis * largest.signum()
    });
    let spread = |i: usize| eigen.eigenvalues[order[i]].max(0.0).sqrt();
    if spread(2) <= FLAT * spread(0) {
        return (long, thin);
    }
    let towards_eye = (thin + 0.55 * long - 0.75 * middle).normalize();
    let right = long - long.dot(towards_eye) * towards_eye;
    (right.normalize(), towards_eye)
}

/// From screen coordinates in mm to pixels.
struct Scale {
    centre: DVec3,
    px_per_mm: f64,
    middle_px: DVec2,
    radius_px: f64,
}

impl Scale {
    fn fit(points: &[DVec3], width: u32, height: u32) -> Option<Self> {
        let mut finite = points.iter().filter(|p| p.is_finite());
        let first = *finite.next()?;
        let (low, high) = finite.fold((first, first), |(low, high), p| (low.min(*p), high.max(*p)));
        let size_px = DVec2::new(f64::from(width), f64::from(height));
        let size = high - low;
        // Points on one line of sight have no width.
        let least = match size.max_element() {
            0.0 => 1.0,
            largest => 1e-3 * largest,
        };
        let extent = size.truncate().max(DVec2::splat(least));
        let px_per_mm = (size_px * (1.0 - 2.0 * MARGIN) / extent).min_element();
        // Half of the points of a solid lie on its far side.
        let area_px = (extent.x * px_per_mm) * (extent.y * px_per_mm);
        let spacing_px = (2.0 * area_px / points.len() as f64).sqrt();
        Some(Self {
            centre: (low + high) / 2.0,
            px_per_mm,
            middle_px: size_px / 2.0,
            radius_px: (0.75 * spacing_px).clamp(1.2, 7.0),
        })
    }

    /// Pixel coordinates, downwards positive, and nearness in pixels.
    fn pixel(&self, point: DVec3) -> DVec3 {
        let p = (point - self.centre) * self.px_per_mm;
        DVec3::new(self.middle_px.x + p.x, self.middle_px.y - p.y, p.z)
    }
}

/// For every pixel the point that is seen there.
struct Canvas {
    width: usize,
    height: usize,
    /// Nearness in pixels, minus infinity where nothing is.
    nearness: Vec<f32>,
    point: Vec<usize>,
}

impl Canvas {
    fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            nearness: vec![f32::NEG_INFINITY; width * height],
            point: vec![0; width * height],
        }
    }

    /// Draws a point as a cap, higher in its middle, so that each of two close ones shows its own side.
    fn disc(&mut self, centre: DVec3, radius: f64, point: usize) {
        let columns = span(centre.x, radius, self.width);
        for row in span(centre.y, radius, self.height) {
            for column in columns.clone() {
                let dx = column as f64 + 0.5 - centre.x;
                let dy = row as f64 + 0.5 - centre.y;
                let squared = (dx * dx + dy * dy) / (radius * radius);
                if squared > 1.0 {
                    continue;
                }
                let nearness = (centre.z - radius * squared) as f32;
                let pixel = row * self.width + column;
                if nearness > self.nearness[pixel] {
                    self.nearness[pixel] = nearness;
                    self.point[pixel] = point;
                }
            }
        }
    }

    /// Pixels row by row, darkened where neighbours are nearer (eye-dome lighting, Boucheny 2009).
    fn shaded(&self, colours: &[[u8; 3]]) -> Vec<u8> {
        let seen = self.nearness.iter().copied().filter(|n| n.is_finite());
        let (far, near) = seen.fold((f32::MAX, f32::MIN), |(a, b), n| (a.min(n), b.max(n)));
        let depth = (near - far).max(1.0);
        let mut pixels = Vec::with_capacity(3 * self.nearness.len());
        for row in 0..self.height {
            for column in 0..self.width {
                let pixel = row * self.width + column;
                let own = self.nearness[pixel];
                if own == f32::NEG_INFINITY {
                    pixels.extend_from_slice(&BACKGROUND);
                    continue;
                }
                let behind: f32 = NEIGHBOURS
                    .iter()
                    .map(|&(dx, dy)| (self.at(column, row, (dx, dy)).unwrap_or(own) - own).max(0.0))
                    .map(|step| (step / depth * STEP_GAIN).min(1.0))
                    .sum();
                let fog = 0.7 + 0.3 * (own - far) / depth;
                let light = fog * (-STEP_STRENGTH * behind / NEIGHBOURS.len() as f32).exp();
                let colour = colours.get(self.point[pixel]).unwrap_or(&NONE);
                pixels.extend(colour.map(|c| (f32::from(c) * light) as u8));
            }
        }
        pixels
    }

    fn at(&self, column: usize, row: usize, (dx, dy): (isize, isize)) -> Option<f32> {
        let column = column.checked_add_signed(dx).filter(|&c| c < self.width)?;
        let row = row.checked_add_signed(dy).filter(|&r| r < self.height)?;
        let nearness = self.nearness[row * self.width + column];
        (nearness > f32::NEG_INFINITY).then_some(nearness)
    }
}

/// Where to look for steps in depth.
const NEIGHBOURS: [(isize, isize); 8] = [
    (-3, 0),
    (3, 0),
    (0, -3),
    (0, 3),
    (-2, -2),
    (2, -2),
    (-2, 2),
    (2, 2),
];
/// A step of the whole depth over this counts in full.
const STEP_GAIN: f32 = 25.0;
const STEP_STRENGTH: f32 = 1.2;

/// The pixels within `radius` of `centre` that are in the picture.
fn span(centre: f64, radius: f64, length: usize) -> std::ops::Range<usize> {
    // A cast keeps within the range of its type.
    let first = (centre - radius).floor().max(0.0) as usize;
    let end = (centre + radius).ceil().max(0.0) as usize;
    first.min(length)..end.min(length)
}

/// The picture of `pixels` (red, green, blue; row by row) as PNG.
pub(crate) fn encode(pixels: &[u8], width: u32, height: u32) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let written = encoder.write_header().and_then(|mut writer| {
        writer.write_image_data(pixels)?;
        writer.finish()
    });
    // The sides are not zero, the pixels as many as they say, and memory takes what is written.
    written.expect("a sound picture is encoded to memory");
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(bytes: &[u8]) -> (u32, u32, Vec<u8>) {
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes))
            .read_info()
            .unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        (info.width, info.height, pixels)
    }

    #[test]
    fn the_nearer_of_two_points_is_seen() {
        let positions = [DVec3::new(0.0, 0.0, 1.0), DVec3::new(0.0, 0.0, -1.0)];
        for (sight, expected) in [(DVec3::NEG_Z, EDGE), (DVec3::Z, CORNER)] {
            let bytes = render(
                &positions,
                &[EDGE, CORNER],
                ViewDirection::Along(sight),
                (9, 9),
            );
            let (width, height, pixels) = decoded(&bytes);
            assert_eq!((width, height), (9, 9));
            let middle = 3 * (4 * 9 + 4);
            assert_eq!(pixels[middle..middle + 3], expected);
        }
    }

    #[test]
    fn right_is_right_and_up_is_up() {
        let ends = [DVec3::X, DVec3::NEG_X, DVec3::Z, DVec3::NEG_Z];
        let colours = [EDGE, CORNER, BOUNDARY, NONE];
        // Looking along plus y, x is to the right and z upwards.
        let bytes = render(&ends, &colours, ViewDirection::Along(DVec3::Y), (100, 100));
        let (_, _, pixels) = decoded(&bytes);
        let at = |column: usize, row: usize| {
            &pixels[3 * (100 * row + column)..3 * (100 * row + column) + 3]
        };
        // Darkening keeps the order of a colour's components.
        let strongest = |pixel: &[u8]| (0..3).max_by_key(|&i| pixel[i]);
        assert_eq!(strongest(at(95, 50)), Some(0), "vermilion");
        assert_eq!(strongest(at(4, 50)), Some(2), "blue");
        assert_eq!(strongest(at(50, 4)), Some(1), "green");
        assert_eq!(at(50, 95)[0], at(50, 95)[2], "grey");
        assert_ne!(at(50, 95), BACKGROUND);
        assert_eq!(at(0, 0), BACKGROUND);
    }

    #[test]
    fn odd_input_gives_a_picture() {
        let one = [DVec3::splat(1e11)];
        let odd: [&[DVec3]; 5] = [
            &[],
            &one,
            &[DVec3::NAN; 3],
            &[DVec3::MAX, DVec3::MIN],
            &[DVec3::ONE; 50],
        ];
        for positions in odd {
            for view in [
                ViewDirection::Auto,
                ViewDirection::Along(DVec3::ZERO),
                ViewDirection::Along(DVec3::NAN),
            ] {
                let (width, height, _) = decoded(&render(positions, &[], view, (0, 30)));
                assert_eq!((width, height), (1, 30));
            }
        }
    }

    #[test]
    fn the_longest_side_lies_across_and_the_same_points_give_the_same_bytes() {
        let slab: Vec<DVec3> = (0..4000)
            .map(|i| DVec3::new(0.0, f64::from(i % 40), f64::from(i / 40)))
            .collect();
        let bytes = render(&slab, &[], ViewDirection::Auto, (200, 200));
        assert_eq!(bytes, render(&slab, &[], ViewDirection::Auto, (200, 200)));
        let (_, _, pixels) = decoded(&bytes);
        let is_drawn = |column: usize, row: usize| pixels[3 * (200 * row + column)] != 0xff;
        assert!(is_drawn(12, 100) && is_drawn(187, 100));
        assert!(
            !is_drawn(100, 50) && !is_drawn(100, 150),
            "100 by 40 points fill two fifths of the height"
        );
    }
}

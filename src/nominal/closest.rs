//! The nearest point of a trimmed face: inside it, or on its border.

use glam::DVec3;

use super::{Foot, Nominal};
use crate::geometry::Surface;

impl Nominal {
    /// The nearest point of the trimmed face with index `face`, never one beyond its border.
    ///
    /// The global minimum: the nearest of all minima of the distance inside the face, and of its border curves. On B-spline
    /// surfaces this is proved by bounds, on swept ones every minimum of the profile is looked at. At a border the normal is
    /// that of the face there. `None` where `p` is not finite or the face has no normal at that place (the apex of a cone).
    pub fn closest(&self, face: u32, p: DVec3) -> Option<Foot> {
        if !p.is_finite() {
            return None;
        }
        let f = self.faces.get(face as usize)?;
        let mut border: Option<(DVec3, f64)> = None;
        for edge in &self.borders[face as usize] {
            let path = &self.paths[*edge as usize];
            let (s_mm, d) = path.nearest(p);
            if border.is_none_or(|b| d < b.1) {
                border = Some((path.at(s_mm).0, d));
            }
        }
        let mut best = border.map_or(f64::INFINITY, |b| b.1);
        let mut inside = None;
        let mut look = |uv: (f64, f64)| {
            let d = f.surface.point(uv.0, uv.1).distance(p);
            if d < best && f.contains(uv) {
                (best, inside) = (d, Some(uv));
            }
        };
        match &f.surface {
            Surface::Nurbs(s) => {
                inside = s.nearest_where(p, best, |uv| f.contains(uv)).map(|b| b.0);
            }
            Surface::Swept(s) => s.minima(p).into_iter().for_each(look),
            // The others have one minimum, or the same distance all along a circle.
            other => look(other.nearest(p, None)),
        }
        if let Some(uv) = inside {
            return f.at(uv);
        }
        let (point, _) = border?;
        f.foot(point, None).map(|foot| Foot { point, ..foot })
    }
}

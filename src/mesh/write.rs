//! Meshes as files: PLY, STL and OBJ that other programs open.

use std::io::Write;

use glam::DVec3;

/// The form of a mesh file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeshForm {
    /// Binary, least significant byte first: `x y z` double, `vertex_indices` list of int.
    Ply,
    /// Binary; coordinates in single precision, as the format has it.
    Stl,
    /// Text.
    Obj,
}

/// The bytes of a file with V `positions`, mm, and F `triangles`.
pub fn mesh_bytes(positions: &[DVec3], triangles: &[[u32; 3]], form: MeshForm) -> Vec<u8> {
    match form {
        MeshForm::Ply => ply(positions, triangles),
        MeshForm::Stl => stl(positions, triangles),
        MeshForm::Obj => obj(positions, triangles),
    }
}

fn ply(positions: &[DVec3], triangles: &[[u32; 3]]) -> Vec<u8> {
    let mut out = format!(
        "ply\nformat binary_little_endian 1.0\ncomment unit mm\nelement vertex {}\n\
         property double x\nproperty double y\nproperty double z\n\
         element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        positions.len(),
        triangles.len()
    )
    .into_bytes();
    out.reserve(24 * positions.len() + 13 * triangles.len());
    for x in positions.iter().flat_map(|p| p.to_array()) {
        out.extend_from_slice(&x.to_le_bytes());
    }
    for t in triangles {
        out.push(3);
        t.iter()
            .for_each(|v| out.extend_from_slice(&v.to_le_bytes()));
    }
    out
}

fn stl(positions: &[DVec3], triangles: &[[u32; 3]]) -> Vec<u8> {
    // 80 bytes of header that must not begin with "solid".
    let mut out = format!("{:<80}", "acies mesh, mm").into_bytes();
    out.reserve(4 + 50 * triangles.len());
    out.extend_from_slice(&(triangles.len() as u32).to_le_bytes());
    for t in triangles {
        let [a, b, c] = t.map(|v| positions[v as usize]);
        let normal = (b - a).cross(c - a).normalize_or_zero();
        for p in [normal, a, b, c] {
            p.to_array()
                .iter()
                .for_each(|x| out.extend_from_slice(&(*x as f32).to_le_bytes()));
        }
        out.extend_from_slice(&[0, 0]);
    }
    out
}

fn obj(positions: &[DVec3], triangles: &[[u32; 3]]) -> Vec<u8> {
    let mut out = b"# acies mesh, mm\n".to_vec();
    // Writing to memory cannot fail.
    for p in positions {
        let _ = writeln!(out, "v {:?} {:?} {:?}", p.x, p.y, p.z);
    }
    for [a, b, c] in triangles {
        let _ = writeln!(out, "f {} {} {}", a + 1, b + 1, c + 1);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_files_have_the_sizes_their_formats_say() {
        let positions = [
            DVec3::ZERO,
            DVec3::X,
            DVec3::Y,
            DVec3::new(0.1, 0.2, 1e-300),
        ];
        let triangles = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        let stl = mesh_bytes(&positions, &triangles, MeshForm::Stl);
        assert_eq!(stl.len(), 84 + 4 * 50);
        assert!(!stl.starts_with(b"solid"));
        let ply = mesh_bytes(&positions, &triangles, MeshForm::Ply);
        let header = ply
            .windows(11)
            .position(|w| w == b"end_header\n")
            .map(|at| at + 11);
        assert_eq!(header.map(|h| ply.len() - h), Some(4 * 24 + 4 * 13));
        let obj = String::from_utf8(mesh_bytes(&positions, &triangles, MeshForm::Obj)).unwrap();
        assert_eq!(obj.lines().nth(4), Some("v 0.1 0.2 1e-300"));
        assert_eq!(obj.lines().last(), Some("f 3 1 4"));
    }
}

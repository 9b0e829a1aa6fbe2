//! The scan coloured by what was found on it.

use crate::points::write::ply_bytes;
use crate::points::{Column, Encoding, PointCloud, PointsError};

/// Red, green, blue by feature: 0 none, 1 edge, 2 corner, 3 boundary; anything else as none.
///
/// After Okabe and Ito's palette, which colour-blind people tell apart, on a light grey for the rest.
const COLOURS: [[u8; 3]; 4] = [
    [190, 196, 202],
    [213, 94, 0],
    [204, 121, 167],
    [0, 114, 178],
];

/// The bytes of a binary PLY: `x y z` double, `red green blue` uchar, `feature` uchar, in the order of the cloud.
///
/// `features` holds one number a point: 0 none, 1 edge, 2 corner, 3 boundary.
///
/// # Errors
/// [`PointsError::ColumnLength`] where `features` and the cloud differ in length.
pub fn to_ply(cloud: &PointCloud, features: &[u8]) -> Result<Vec<u8>, PointsError> {
    let channel = |c: usize| -> Vec<u8> {
        features
            .iter()
            .map(|&feature| COLOURS.get(usize::from(feature)).unwrap_or(&COLOURS[0])[c])
            .collect()
    };
    let [red, green, blue] = [channel(0), channel(1), channel(2)];
    let columns = [
        Column::U8("red", &red),
        Column::U8("green", &green),
        Column::U8("blue", &blue),
        Column::U8("feature", features),
    ];
    ply_bytes(&cloud.positions, &columns, Encoding::LittleEndian)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::points::Frame;

    fn cloud() -> PointCloud {
        PointCloud::from_positions(Frame::Part, vec![DVec3::ZERO, DVec3::new(1.0, 2.0, 3.0)])
    }

    #[test]
    fn the_layout_is_the_one_viewers_know() {
        let bytes = to_ply(&cloud(), &[0, 1]).expect("two points, two features");
        let header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty double x\nproperty double y\n\
                      property double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n\
                      property uchar feature\nend_header\n";
        assert_eq!(&bytes[..header.len()], header.as_bytes());
        let second = &bytes[header.len() + 28..];
        assert_eq!(second[..8], 1.0f64.to_le_bytes());
        assert_eq!(second[24..], [213, 94, 0, 1]);
        assert_eq!(bytes.len(), header.len() + 2 * 28);
    }

    #[test]
    fn a_missing_feature_is_refused() {
        let error = to_ply(&cloud(), &[1]).expect_err("one feature short");
        let text = error.to_string();
        assert!(text.contains('1') && text.contains('2'), "{text}");
    }

    #[test]
    fn an_unknown_feature_is_drawn_as_none() {
        let bytes = to_ply(&cloud(), &[9, 0]).expect("two points, two features");
        assert_eq!(
            bytes[bytes.len() - 32..bytes.len() - 28],
            [190, 196, 202, 9]
        );
    }
}

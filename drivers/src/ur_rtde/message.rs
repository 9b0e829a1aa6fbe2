//! Packages of RTDE, as in the guide: big-endian, `u16 size` (of the whole package), `u8 type`, payload. Pure functions.

use crate::error::DecodeError;

/// Size and type.
pub const HEADER: usize = 3;

/// Package types, named as in the guide. Requests and replies share them.
pub mod kind {
    /// RTDE_REQUEST_PROTOCOL_VERSION
    pub const PROTOCOL_VERSION: u8 = b'V';
    /// RTDE_GET_URCONTROL_VERSION
    pub const CONTROL_VERSION: u8 = b'v';
    /// RTDE_TEXT_MESSAGE
    pub const TEXT: u8 = b'M';
    /// RTDE_DATA_PACKAGE
    pub const DATA: u8 = b'U';
    /// RTDE_CONTROL_PACKAGE_SETUP_OUTPUTS
    pub const SETUP_OUTPUTS: u8 = b'O';
    /// RTDE_CONTROL_PACKAGE_START
    pub const START: u8 = b'S';
    /// RTDE_CONTROL_PACKAGE_PAUSE
    pub const PAUSE: u8 = b'P';
}

/// The outputs that we ask for, in this order, and the types that they have.
pub const RECIPE: [(&str, &str); 2] = [("timestamp", "DOUBLE"), ("actual_TCP_pose", "VECTOR6D")];

/// Bytes of a data package with [`RECIPE`]: the recipe's number, a DOUBLE, a VECTOR6D.
const DATA_BYTES: usize = 1 + 8 + 6 * 8;

/// One package.
#[derive(Debug, Clone, PartialEq)]
pub enum Package {
    /// Whether the version that was asked for is spoken.
    ProtocolVersion(bool),
    /// Major, minor, bugfix, build of the controller.
    ControlVersion([u32; 4]),
    /// What the controller tells.
    Text(Text),
    /// The answer to a list of outputs.
    Outputs(Outputs),
    /// Whether data will come.
    Started(bool),
    /// Whether no more data will come.
    Paused(bool),
    /// The outputs of [`RECIPE`].
    Data(Data),
}

/// A text of the controller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Text {
    /// What it says.
    pub message: String,
    /// Who says it.
    pub source: String,
    /// 0 exception, 1 error, 2 warning, 3 information.
    pub level: u8,
}

/// The answer to a list of outputs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outputs {
    /// Number that the data packages will bear; 0 where the list was refused.
    pub recipe: u8,
    /// One type for every name asked for, or `NOT_FOUND`.
    pub types: Vec<String>,
}

/// One pose of the tool's centre point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Data {
    /// Number of the list of outputs.
    pub recipe: u8,
    /// Since the controller was started, s.
    pub timestamp_s: f64,
    /// Place in the robot's base frame, m.
    pub position_m: [f64; 3],
    /// Axis times angle, rad.
    pub rotation: [f64; 3],
}

impl Data {
    /// Every field is a number that a robot can mean: a controller that answers is on for a millisecond and not for thirty years, the
    /// place is within 100 m. A number with its bytes in the wrong order is mostly next to nothing or beyond all bounds, and what is as
    /// small as that is no rounded zero.
    pub fn is_sound(&self) -> bool {
        let possible = |v: &f64| *v == 0.0 || (1e-30..100.0).contains(&v.abs());
        (1e-3..1e9).contains(&self.timestamp_s)
            && self.position_m.iter().chain(&self.rotation).all(possible)
    }
}

/// Why a package was not understood.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Bad {
    /// Where the next one begins is not known either.
    Framing(DecodeError),
    /// This one alone; the next begins after so many bytes.
    Package(DecodeError, usize),
}

/// Takes the first package of `bytes`: it, and how many bytes it has; `None` where more are needed.
///
/// # Errors
/// [`Bad`]. A package has at most 64 KiB, which is what its size can say.
pub fn package(bytes: &[u8]) -> Result<Option<(Package, usize)>, Bad> {
    let [high, low, kind, ..] = *bytes else {
        return Ok(None);
    };
    let size = usize::from(u16::from_be_bytes([high, low]));
    if size < HEADER {
        return Err(Bad::Framing(DecodeError::TooShort {
            message: "package",
            found: size,
            needed: HEADER,
        }));
    }
    if !KINDS.contains(&kind) {
        return Err(Bad::Framing(DecodeError::UnknownType { found: kind }));
    }
    let Some(payload) = bytes.get(HEADER..size) else {
        return Ok(None);
    };
    match content(kind, payload) {
        Ok(package) => Ok(Some((package, size))),
        Err(error) => Err(Bad::Package(error, size)),
    }
}

/// What a controller sends to us.
const KINDS: [u8; 7] = [
    kind::PROTOCOL_VERSION,
    kind::CONTROL_VERSION,
    kind::TEXT,
    kind::DATA,
    kind::SETUP_OUTPUTS,
    kind::START,
    kind::PAUSE,
];

fn content(kind: u8, payload: &[u8]) -> Result<Package, DecodeError> {
    Ok(match kind {
        kind::PROTOCOL_VERSION => Package::ProtocolVersion(accepted("protocol version", payload)?),
        kind::START => Package::Started(accepted("start", payload)?),
        kind::PAUSE => Package::Paused(accepted("pause", payload)?),
        kind::CONTROL_VERSION => Package::ControlVersion(control_version(payload)?),
        kind::SETUP_OUTPUTS => Package::Outputs(outputs(payload)?),
        kind::TEXT => Package::Text(text(payload)?),
        _ => Package::Data(data(payload)?),
    })
}

fn short(message: &'static str, payload: &[u8], needed: usize) -> DecodeError {
    DecodeError::TooShort {
        message,
        found: payload.len(),
        needed,
    }
}

fn accepted(message: &'static str, payload: &[u8]) -> Result<bool, DecodeError> {
    let first = payload.first().ok_or_else(|| short(message, payload, 1))?;
    Ok(*first != 0)
}

fn control_version(payload: &[u8]) -> Result<[u32; 4], DecodeError> {
    let bytes: &[u8; 16] = payload
        .first_chunk()
        .ok_or_else(|| short("control version", payload, 16))?;
    Ok(std::array::from_fn(|i| {
        u32::from_be_bytes(std::array::from_fn(|k| bytes[4 * i + k]))
    }))
}

fn outputs(payload: &[u8]) -> Result<Outputs, DecodeError> {
    let (recipe, types) = payload
        .split_first()
        .ok_or_else(|| short("setup of outputs", payload, 1))?;
    let types = std::str::from_utf8(types).map_err(|_| DecodeError::Text {
        message: "setup of outputs",
    })?;
    Ok(Outputs {
        recipe: *recipe,
        types: types.split(',').map(|t| t.trim().to_owned()).collect(),
    })
}

/// Version 2 of the protocol: two texts with their lengths, then the level.
fn text(payload: &[u8]) -> Result<Text, DecodeError> {
    let lost = || short("text message", payload, payload.len() + 1);
    let counted = |rest: &[u8]| {
        let (length, rest) = rest.split_first()?;
        let (text, rest) = rest.split_at_checked(usize::from(*length))?;
        // A controller's texts may be in any of its languages' code pages: what is no UTF-8 is shown as such.
        Some((String::from_utf8_lossy(text).into_owned(), rest.to_vec()))
    };
    let (message, rest) = counted(payload).ok_or_else(lost)?;
    let (source, rest) = counted(&rest).ok_or_else(lost)?;
    let level = *rest.first().ok_or_else(lost)?;
    Ok(Text {
        message,
        source,
        level,
    })
}

fn data(payload: &[u8]) -> Result<Data, DecodeError> {
    if payload.len() != DATA_BYTES {
        return Err(short("data package", payload, DATA_BYTES));
    }
    let number = |i: usize| {
        let at = 1 + 8 * i;
        f64::from_be_bytes(std::array::from_fn(|k| payload[at + k]))
    };
    Ok(Data {
        recipe: payload[0],
        timestamp_s: number(0),
        position_m: [number(1), number(2), number(3)],
        rotation: [number(4), number(5), number(6)],
    })
}

/// A request: header and payload. A payload beyond what a package holds is cut; ours have a few dozen bytes.
pub fn request(kind: u8, payload: &[u8]) -> Vec<u8> {
    let payload = &payload[..payload.len().min(usize::from(u16::MAX) - HEADER)];
    let size = (HEADER + payload.len()) as u16;
    let mut bytes = size.to_be_bytes().to_vec();
    bytes.push(kind);
    bytes.extend(payload);
    bytes
}

/// The request for version 2, the first one in which the rate of the outputs is asked for.
pub fn protocol_version_2() -> Vec<u8> {
    request(kind::PROTOCOL_VERSION, &[0, 2])
}

/// The request for the outputs of [`RECIPE`], `rate_hz` times a second.
pub fn setup_outputs(rate_hz: f64) -> Vec<u8> {
    let mut payload = rate_hz.to_be_bytes().to_vec();
    payload.extend(RECIPE.map(|(name, _)| name).join(",").bytes());
    request(kind::SETUP_OUTPUTS, &payload)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_guides_requests_and_answers() {
        assert_eq!(protocol_version_2(), [0x00, 0x05, 0x56, 0x00, 0x02]);
        // 125 Hz is 405F 4000 0000 0000 as a double.
        let asked = setup_outputs(125.0);
        assert_eq!(asked[..11], [0, 36, b'O', 0x40, 0x5F, 0x40, 0, 0, 0, 0, 0]);
        assert_eq!(asked[11..], *b"timestamp,actual_TCP_pose");
        let answers: &[(&[u8], Package)] = &[
            (&[0, 4, b'V', 1], Package::ProtocolVersion(true)),
            (&[0, 4, b'S', 0], Package::Started(false)),
            (&[0, 4, b'P', 1], Package::Paused(true)),
            (
                &[
                    0, 19, b'v', 0, 0, 0, 5, 0, 0, 0, 12, 0, 0, 0, 2, 0, 16, 0xCE, 0x3D,
                ],
                Package::ControlVersion([5, 12, 2, 1_101_373]),
            ),
            (
                b"\x00\x13O\x01DOUBLE,VECTOR6D",
                Package::Outputs(Outputs {
                    recipe: 1,
                    types: vec!["DOUBLE".into(), "VECTOR6D".into()],
                }),
            ),
            (
                b"\x00\x0FM\x05hello\x04RTDE\x03",
                Package::Text(Text {
                    message: "hello".into(),
                    source: "RTDE".into(),
                    level: 3,
                }),
            ),
        ];
        for (bytes, expected) in answers {
            let found = package(bytes).expect("an answer of the guide");
            assert_eq!(found, Some((expected.clone(), bytes.len())));
            for short in 0..bytes.len() {
                assert_eq!(package(&bytes[..short]), Ok(None), "{short} bytes");
            }
        }
    }

    #[test]
    fn a_pose_comes_out_as_the_numbers_that_went_in_big_end_first() {
        let numbers = [12.5, -0.25, 0.5, 1.0, 0.0, 3.0, -1.5];
        let mut payload = vec![7];
        payload.extend(numbers.iter().flat_map(|v: &f64| v.to_be_bytes()));
        let bytes = request(kind::DATA, &payload);
        assert_eq!(bytes.len(), 60);
        let Ok(Some((Package::Data(data), 60))) = package(&bytes) else {
            panic!("{:?}", package(&bytes));
        };
        assert_eq!((data.recipe, data.timestamp_s), (7, 12.5));
        assert_eq!(data.position_m, [-0.25, 0.5, 1.0]);
        assert_eq!(data.rotation, [0.0, 3.0, -1.5]);
        assert!(data.is_sound());
        // The same bytes with the small end first are no pose.
        let mut payload = vec![7];
        payload.extend(numbers.iter().flat_map(|v: &f64| v.to_le_bytes()));
        let Ok(Some((Package::Data(turned), _))) = package(&request(kind::DATA, &payload)) else {
            panic!("a data package");
        };
        assert_ne!(turned, data);
    }

    #[test]
    fn what_is_wrong_is_told_and_how_far_it_reaches() {
        assert!(matches!(package(&[0, 2, b'U']), Err(Bad::Framing(_))));
        assert!(matches!(
            package(b"HTTP/1.1 400"),
            Err(Bad::Framing(DecodeError::UnknownType { found: b'T' }))
        ));
        // A data package of another list of outputs: the next one is where its size says.
        let odd = request(kind::DATA, &[1; 20]);
        assert!(matches!(package(&odd), Err(Bad::Package(_, 23))));
        let text = request(kind::TEXT, b"\xFFshort");
        assert!(matches!(package(&text), Err(Bad::Package(_, 9))));
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_to_their_end_without_a_panic(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            let mut rest = &bytes[..];
            while !rest.is_empty() {
                match package(rest) {
                    Ok(Some((_, used))) | Err(Bad::Package(_, used)) => {
                        prop_assert!((HEADER..=rest.len()).contains(&used));
                        rest = &rest[used..];
                    }
                    Ok(None) | Err(Bad::Framing(_)) => break,
                }
            }
        }
    }
}

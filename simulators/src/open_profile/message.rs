//! Payloads of sections 3 to 6.

use crate::sensor::Line;

pub(super) const HELLO: u8 = 0x01;
pub(super) const SET: u8 = 0x02;
pub(super) const GET: u8 = 0x03;
pub(super) const START: u8 = 0x04;
pub(super) const STOP: u8 = 0x05;
pub(super) const KEEPALIVE: u8 = 0x06;
pub(super) const IDENTITY: u8 = 0x81;
pub(super) const VALUE: u8 = 0x82;
pub(super) const STARTED: u8 = 0x84;
pub(super) const STOPPED: u8 = 0x85;
pub(super) const ALIVE: u8 = 0x86;
pub(super) const PROFILE: u8 = 0x90;
pub(super) const REFUSED: u8 = 0x9F;

/// Status numbers of section 3.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Status {
    Done = 0,
    UnknownKey = 1,
    OutOfRange = 2,
    ReadOnly = 3,
    NotWhileStreaming = 4,
    UnknownCommand = 5,
    TooShort = 6,
}

/// Why a run ended, section 7.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Reason {
    Asked = 0,
    CountReached = 1,
    KeepaliveLost = 2,
    LinkLost = 5,
}

/// Capabilities of section 4.
pub(super) const ENCODER: u32 = 1;
pub(super) const INTENSITY: u32 = 1 << 1;
pub(super) const EXPLICIT_X: u32 = 1 << 2;
pub(super) const LASER_SWITCH: u32 = 1 << 4;

/// Content of IDENTITY.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Identity {
    pub boot: u32,
    pub columns_max: u32,
    pub rate_max_mhz: u32,
    pub capabilities: u32,
    pub near_um: i32,
    pub far_um: i32,
    pub width_um: u32,
    /// Vendor, model, serial number, firmware; at most 255 bytes each.
    pub texts: [String; 4],
}

impl Identity {
    pub fn payload(&self) -> Vec<u8> {
        let mut out = Vec::new();
        out.extend(self.boot.to_le_bytes());
        out.extend(self.columns_max.to_le_bytes());
        out.extend(self.rate_max_mhz.to_le_bytes());
        out.extend(self.capabilities.to_le_bytes());
        out.extend(self.near_um.to_le_bytes());
        out.extend(self.far_um.to_le_bytes());
        out.extend(self.width_um.to_le_bytes());
        out.extend([0; 4]);
        for text in &self.texts {
            let end = text.floor_char_boundary(255);
            out.push(end as u8);
            out.extend(&text.as_bytes()[..end]);
        }
        out
    }
}

/// VALUE: a setting's value with its limits.
pub(super) fn value(status: Status, key: u16, [now, least, most]: [i64; 3]) -> Vec<u8> {
    let mut out = Vec::new();
    out.extend((status as u16).to_le_bytes());
    out.extend(key.to_le_bytes());
    for number in [now, least, most] {
        out.extend(number.to_le_bytes());
    }
    out
}

pub(super) fn started(status: Status, run: u32, boot: u32) -> Vec<u8> {
    let mut out = Vec::new();
    out.extend((status as u16).to_le_bytes());
    out.extend(run.to_le_bytes());
    out.extend(boot.to_le_bytes());
    out
}

pub(super) fn stopped(reason: Reason, run: u32, sent: u32, dropped: u32) -> Vec<u8> {
    let mut out = Vec::new();
    out.extend((reason as u16).to_le_bytes());
    for number in [run, sent, dropped] {
        out.extend(number.to_le_bytes());
    }
    out
}

pub(super) fn alive(host_ns: u64, device_ns: u64, boot: u32, laser_on: bool) -> Vec<u8> {
    let mut out = Vec::new();
    out.extend(host_ns.to_le_bytes());
    out.extend(device_ns.to_le_bytes());
    out.extend(boot.to_le_bytes());
    out.extend(u16::from(laser_on).to_le_bytes());
    out
}

pub(super) fn refused(status: Status, text: &str) -> Vec<u8> {
    let mut out = Vec::new();
    out.extend((status as u16).to_le_bytes());
    out.extend((text.len() as u16).to_le_bytes());
    out.extend(text.as_bytes());
    out
}

/// Everything in a PROFILE beside the points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ProfileHead {
    pub run: u32,
    pub boot: u32,
    pub time_ns: u64,
    pub encoder: i64,
    pub dropped: u32,
    pub flags: u16,
    pub scale: Scale,
}

/// How numbers become counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Scale {
    /// Samples of 32 bits.
    pub wide: bool,
    /// x as samples, not by index.
    pub explicit_x: bool,
    pub intensity: bool,
    pub x_scale_nm: u32,
    pub x_offset_nm: i64,
    pub z_scale_nm: u32,
    pub z_offset_nm: i64,
}

impl Scale {
    fn format(&self) -> u16 {
        u16::from(self.explicit_x) | u16::from(self.intensity) << 1 | u16::from(self.wide) << 2
    }

    fn most(&self) -> i64 {
        if self.wide {
            i32::MAX.into()
        } else {
            i16::MAX.into()
        }
    }

    fn push(&self, out: &mut Vec<u8>, count: i64) {
        if self.wide {
            out.extend((count as i32).to_le_bytes());
        } else {
            out.extend((count as i16).to_le_bytes());
        }
    }

    /// The nearest count; `None` when the sample cannot hold it.
    fn count(&self, value_mm: f64, scale_nm: u32, offset_nm: i64) -> Option<i64> {
        let count = ((value_mm * 1e6 - offset_nm as f64) / f64::from(scale_nm)).round();
        (count.abs() <= self.most() as f64).then_some(count as i64)
    }
}

/// PROFILE. A point outside what a sample can hold is sent as not seen.
pub(super) fn profile(head: &ProfileHead, line: &Line) -> Vec<u8> {
    let s = &head.scale;
    let n = line.z_mm.len();
    let mut out = Vec::with_capacity(60 + 10 * n);
    out.extend(60_u16.to_le_bytes());
    out.extend((n as u16).to_le_bytes());
    out.extend(head.run.to_le_bytes());
    out.extend(head.boot.to_le_bytes());
    out.extend(head.time_ns.to_le_bytes());
    out.extend(head.encoder.to_le_bytes());
    out.extend(head.dropped.to_le_bytes());
    out.extend(head.flags.to_le_bytes());
    out.extend(s.format().to_le_bytes());
    out.extend(s.x_scale_nm.to_le_bytes());
    out.extend(s.x_offset_nm.to_le_bytes());
    out.extend(s.z_scale_nm.to_le_bytes());
    out.extend(s.z_offset_nm.to_le_bytes());
    let x = |i: usize| s.count(line.x_mm[i], s.x_scale_nm, s.x_offset_nm);
    for (i, &z) in line.z_mm.iter().enumerate() {
        let count = s.count(z, s.z_scale_nm, s.z_offset_nm);
        let seen = count.filter(|_| !s.explicit_x || x(i).is_some());
        s.push(&mut out, seen.unwrap_or(-s.most() - 1));
    }
    if s.explicit_x {
        (0..n).for_each(|i| s.push(&mut out, x(i).unwrap_or(0)));
    }
    if s.intensity {
        for &light in &line.intensity {
            out.extend(light.to_le_bytes());
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::frame::encode;
    use super::*;

    const BOOT: u32 = 0xC0FF_EE01;

    /// The bytes of an example of section 8, read from the protocol's document.
    fn example(name: &str) -> Vec<u8> {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../drivers/open-profile.md");
        let document = std::fs::read_to_string(path).unwrap();
        let mut lines = document.lines();
        lines
            .find(|l| l.starts_with(&format!("- `{name}`:")))
            .unwrap_or_else(|| panic!("no example {name}"));
        let hex = lines.next().unwrap().trim().trim_matches('`');
        hex.split(' ')
            .map(|b| u8::from_str_radix(b, 16).unwrap())
            .collect()
    }

    #[test]
    fn replies_are_the_documents_bytes() {
        let identity = Identity {
            boot: BOOT,
            columns_max: 640,
            rate_max_mhz: 2_000_000,
            capabilities: ENCODER | INTENSITY | EXPLICIT_X | LASER_SWITCH,
            near_um: 60_000,
            far_um: 140_000,
            width_um: 90_000,
            texts: ["Acies", "open-1", "P-0042", "1.0.0"].map(String::from),
        };
        let rate = value(Status::Done, 1, [500_000, 1000, 2_000_000]);
        let columns = value(Status::OutOfRange, 5, [640, 1, 640]);
        for (name, frame) in [
            ("identity", encode(IDENTITY, 1, &identity.payload())),
            ("value-rate", encode(VALUE, 2, &rate)),
            ("set-refused", encode(VALUE, 3, &columns)),
            (
                "started",
                encode(STARTED, 4, &started(Status::Done, 7, BOOT)),
            ),
            (
                "alive",
                encode(ALIVE, 5, &alive(1_000_000, 2_600_000, BOOT, true)),
            ),
            (
                "stopped",
                encode(STOPPED, 6, &stopped(Reason::Asked, 7, 2, 3)),
            ),
            (
                "refused",
                encode(REFUSED, 9, &refused(Status::UnknownCommand, "type 0x42?")),
            ),
        ] {
            assert_eq!(frame, example(name), "{name}");
        }
    }

    #[test]
    fn profiles_are_the_documents_bytes() {
        let implicit = Line {
            encoder: -3,
            x_mm: vec![-15.0, -5.0, 5.0, 15.0],
            z_mm: vec![100.0, 100.002, f64::NAN, 99.998],
            intensity: vec![],
            saturated: false,
        };
        let head = ProfileHead {
            run: 7,
            boot: BOOT,
            time_ns: 1_500_000,
            encoder: -3,
            dropped: 0,
            flags: 1,
            scale: Scale {
                wide: false,
                explicit_x: false,
                intensity: false,
                x_scale_nm: 10_000_000,
                x_offset_nm: -15_000_000,
                z_scale_nm: 2000,
                z_offset_nm: 100_000_000,
            },
        };
        let frame = encode(PROFILE, 0, &profile(&head, &implicit));
        assert_eq!(frame, example("profile-implicit"));

        let explicit = Line {
            encoder: 400,
            x_mm: vec![-1.25, 1.25],
            z_mm: vec![80.5, 80.75],
            intensity: vec![1000, 65535],
            saturated: true,
        };
        let head = ProfileHead {
            time_ns: 2_500_000,
            encoder: 400,
            dropped: 3,
            flags: 3,
            scale: Scale {
                wide: true,
                explicit_x: true,
                intensity: true,
                x_scale_nm: 10,
                x_offset_nm: 0,
                z_scale_nm: 10,
                z_offset_nm: 80_000_000,
            },
            ..head
        };
        let frame = encode(PROFILE, 1, &profile(&head, &explicit));
        assert_eq!(frame, example("profile-explicit"));
    }
}

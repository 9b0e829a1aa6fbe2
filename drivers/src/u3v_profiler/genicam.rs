//! As much of a GenICam file as a profiler needs: where a feature's value lies in the device's memory, or in which chunk.
//!
//! Source: GenICam Standard 2.1, GenApi. Understood are Integer, Float, Boolean, Enumeration, Command, String, IntReg, MaskedIntReg, FloatReg, StringReg,
//! Port with ChunkID, and addresses summed of Address, pAddress and pIndex. We differ: nothing is computed by formulas (SwissKnife, Converter); a feature
//! that needs one is refused by name.

use std::collections::HashMap;

use crate::error::DecodeError;

/// Most bytes of a file, as it is and unpacked.
pub const FILE_MAX: usize = 16 << 20;
/// Most nodes that are followed from a feature to its register.
const DEPTH_MAX: u32 = 16;

/// A register: bytes of memory or of a chunk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Register {
    /// Where, in the device's memory or from the start of the chunk.
    pub address: u64,
    /// Its bytes.
    pub length: usize,
    /// Big-endian.
    pub big: bool,
    /// A number that may be negative.
    pub signed: bool,
    /// A floating-point number.
    pub float: bool,
    /// Least and highest bit of the number, where it is a part of the register.
    pub bits: Option<(u32, u32)>,
    /// The chunk it lies in.
    pub chunk: Option<u32>,
}

/// What a node refers to.
#[derive(Debug, Clone, Default)]
struct Node {
    kind: String,
    text: HashMap<String, String>,
    addresses: Vec<Address>,
    entries: Vec<(String, i64)>,
}

/// One part of an address.
#[derive(Debug, Clone)]
enum Address {
    Fixed(u64),
    Of(String),
    Index { of: String, step: i64 },
}

/// Where a feature's value comes from.
#[derive(Debug, Clone, PartialEq)]
pub enum Place {
    /// The file says it.
    Constant(f64),
    /// A register has it.
    Register(Register),
}

/// The nodes of a device.
#[derive(Debug, Default)]
pub struct Features {
    nodes: HashMap<String, Node>,
}

/// Reads numbers that addresses depend on.
pub trait Memory {
    /// Why a number cannot be read.
    type Error: From<DecodeError>;
    /// The integer in a register.
    ///
    /// # Errors
    /// Whatever keeps it from being read.
    fn integer(&mut self, register: &Register) -> Result<i64, Self::Error>;
}

impl Features {
    /// Reads a file: XML, or a ZIP archive of one file.
    ///
    /// # Errors
    /// A file that is neither, or is larger than [`FILE_MAX`].
    pub fn read(file: &[u8]) -> Result<Features, DecodeError> {
        let unpacked;
        let bytes = match file.starts_with(b"PK\x03\x04") {
            true => {
                unpacked = unzip(file).ok_or(TEXT)?;
                &unpacked
            }
            false => file,
        };
        let end = bytes
            .iter()
            .rposition(|&b| b != 0)
            .map_or(0, |last| last + 1);
        let text = std::str::from_utf8(&bytes[..end]).map_err(|_| TEXT)?;
        let document =
            roxmltree::Document::parse(text.trim_start_matches('\u{feff}')).map_err(|error| {
                DecodeError::Line {
                    line: format!("GenICam file: {error}"),
                }
            })?;
        let mut features = Features::default();
        for node in document.descendants().filter(|n| n.is_element()) {
            if let Some(name) = node
                .attribute("Name")
                .filter(|_| !node.has_tag_name("EnumEntry"))
            {
                features.nodes.insert(name.to_owned(), read_node(&node));
            }
        }
        Ok(features)
    }

    /// Whether there is such a feature.
    pub fn contains(&self, name: &str) -> bool {
        self.nodes.contains_key(name)
    }

    /// Where the value of a feature is; `memory` is asked for what its address depends on.
    ///
    /// # Errors
    /// A feature that is not there, or that is computed by a formula.
    pub fn place<M: Memory>(&self, name: &str, memory: &mut M) -> Result<Place, M::Error> {
        self.follow(name, memory, DEPTH_MAX)
    }

    /// The number behind a word of an enumeration.
    pub fn entry(&self, feature: &str, word: &str) -> Option<i64> {
        let entries = &self.nodes.get(feature)?.entries;
        entries
            .iter()
            .find(|(name, _)| name == word)
            .map(|(_, value)| *value)
    }

    /// What is written to carry out a command, or for true and false.
    pub fn number(&self, feature: &str, field: &str) -> Option<i64> {
        integer(self.nodes.get(feature)?.text.get(field)?)
    }

    fn follow<M: Memory>(&self, name: &str, memory: &mut M, depth: u32) -> Result<Place, M::Error> {
        let Some(node) = self.nodes.get(name).filter(|_| depth > 0) else {
            return Err(refused(name, "no such feature").into());
        };
        if node.kind.ends_with("Reg") || node.kind == "Register" {
            return self
                .register(name, node, memory, depth)
                .map(Place::Register);
        }
        if let Some(next) = node.text.get("pValue") {
            if node.kind.contains("SwissKnife") || node.kind.contains("Converter") {
                return Err(refused(name, "computed by a formula").into());
            }
            return self.follow(next, memory, depth - 1);
        }
        match node.text.get("Value").and_then(|text| real(text)) {
            Some(value) => Ok(Place::Constant(value)),
            None => Err(refused(
                name,
                &format!("a {} without a value that is understood", node.kind),
            )
            .into()),
        }
    }

    fn register<M: Memory>(
        &self,
        name: &str,
        node: &Node,
        memory: &mut M,
        depth: u32,
    ) -> Result<Register, M::Error> {
        let mut address = 0_u64;
        for part in &node.addresses {
            let (of, step) = match part {
                Address::Fixed(offset) => {
                    address = address.wrapping_add(*offset);
                    continue;
                }
                Address::Of(of) => (of, 1),
                Address::Index { of, step } => (of, *step),
            };
            let value = match self.follow(of, memory, depth - 1)? {
                Place::Constant(value) => value as i64,
                Place::Register(register) => memory.integer(&register)?,
            };
            address = address.wrapping_add(value.wrapping_mul(step) as u64);
        }
        let text = |key: &str| node.text.get(key).map(String::as_str);
        let length = text("Length").and_then(integer).unwrap_or(0);
        if !(1..=4096).contains(&length) {
            return Err(refused(name, "no register length of 1 to 4096").into());
        }
        let bit = |key: &str| {
            text(key)
                .and_then(integer)
                .and_then(|bit| u32::try_from(bit).ok())
        };
        let (low, high) = (bit("LSB").or(bit("Bit")), bit("MSB").or(bit("Bit")));
        let port = text("pPort").and_then(|port| self.nodes.get(port));
        Ok(Register {
            address,
            length: length as usize,
            big: text("Endianess") == Some("BigEndian"),
            signed: text("Sign") == Some("Signed"),
            float: node.kind == "FloatReg",
            bits: low
                .zip(high)
                .map(|(a, b)| (a.min(b), a.max(b)))
                .filter(|(_, high)| *high < 64),
            chunk: port
                .and_then(|port| port.text.get("ChunkID"))
                .and_then(|id| u32::from_str_radix(id.trim().trim_start_matches("0x"), 16).ok()),
        })
    }
}

/// The file is no text.
const TEXT: DecodeError = DecodeError::Text {
    message: "the GenICam file",
};

fn refused(name: &str, why: &str) -> DecodeError {
    DecodeError::Line {
        line: format!("GenICam feature {name}: {why}"),
    }
}

fn read_node(element: &roxmltree::Node<'_, '_>) -> Node {
    let mut node = Node {
        kind: element.tag_name().name().to_owned(),
        ..Node::default()
    };
    for child in element.children().filter(|n| n.is_element()) {
        let text = child.text().unwrap_or_default().trim();
        match child.tag_name().name() {
            "Address" => node
                .addresses
                .extend(integer(text).map(|a| Address::Fixed(a as u64))),
            "pAddress" => node.addresses.push(Address::Of(text.to_owned())),
            "pIndex" => node.addresses.push(Address::Index {
                of: text.to_owned(),
                step: child.attribute("Offset").and_then(integer).unwrap_or(1),
            }),
            "EnumEntry" => {
                let value = child.children().find(|n| n.has_tag_name("Value"));
                let value = value.and_then(|n| integer(n.text()?.trim()));
                if let (Some(name), Some(value)) = (child.attribute("Name"), value) {
                    node.entries.push((name.to_owned(), value));
                }
            }
            tag => {
                node.text
                    .entry(tag.to_owned())
                    .or_insert_with(|| text.to_owned());
            }
        }
    }
    node
}

fn integer(text: &str) -> Option<i64> {
    let text = text.trim();
    match text.strip_prefix("0x").or(text.strip_prefix("0X")) {
        Some(hex) => u64::from_str_radix(hex, 16).ok().map(|n| n as i64),
        None => text.parse().ok(),
    }
}

fn real(text: &str) -> Option<f64> {
    integer(text)
        .map(|n| n as f64)
        .or_else(|| text.trim().parse().ok())
}

/// The first file of an archive, at most [`FILE_MAX`] long.
fn unzip(archive: &[u8]) -> Option<Vec<u8>> {
    let u16_at = |at: usize| {
        Some(u16::from_le_bytes(
            archive.get(at..at + 2)?.try_into().ok()?,
        ))
    };
    let start = 30 + usize::from(u16_at(26)?) + usize::from(u16_at(28)?);
    // Where sizes stand behind the data, the stream of deflate says its own end.
    let data = archive.get(start..)?;
    match u16_at(8)? {
        0 => {
            let size = u32::from_le_bytes(archive.get(18..22)?.try_into().ok()?) as usize;
            data.get(..size).map(<[u8]>::to_vec)
        }
        8 => miniz_oxide::inflate::decompress_to_vec_with_limit(data, FILE_MAX).ok(),
        _ => None,
    }
}

impl Register {
    /// Bits of the number.
    pub fn width(&self) -> u32 {
        let all = 8 * self.length.min(8) as u32;
        self.bits.map_or(all, |(low, high)| high - low + 1)
    }

    /// The integer in the register's bytes.
    pub fn integer(&self, bytes: &[u8]) -> i64 {
        let mut value = 0_u64;
        let n = bytes.len().min(8);
        for i in 0..n {
            let byte = if self.big { bytes[i] } else { bytes[n - 1 - i] };
            value = value << 8 | u64::from(byte);
        }
        let mut width = 8 * n as u32;
        if let Some((low, high)) = self.bits {
            value = value.checked_shr(low).unwrap_or(0);
            width = high - low + 1;
        }
        if width < 64 {
            value &= (1 << width) - 1;
        }
        let negative = self.signed && width > 0 && width < 64 && value >> (width - 1) & 1 == 1;
        match negative {
            true => (value | (u64::MAX << width)) as i64,
            false => value as i64,
        }
    }

    /// The number in the register's bytes.
    pub fn number(&self, bytes: &[u8]) -> f64 {
        if !self.float {
            return self.integer(bytes) as f64;
        }
        let raw = Register {
            float: false,
            signed: false,
            bits: None,
            ..*self
        }
        .integer(bytes) as u64;
        match self.length {
            4 => f32::from_bits(raw as u32).into(),
            _ => f64::from_bits(raw),
        }
    }

    /// The register's bytes with a number in them; `before` has the bits that stay.
    pub fn encode(&self, number: f64, before: &[u8]) -> Vec<u8> {
        let raw = match (self.float, self.length) {
            (true, 4) => u64::from((number as f32).to_bits()),
            (true, _) => number.to_bits(),
            (false, _) => number.round() as i64 as u64,
        };
        let raw = match self.bits {
            None => raw,
            Some((low, high)) => {
                let mask = (u64::MAX >> (63 - (high - low))) << low;
                let whole = Register {
                    signed: false,
                    bits: None,
                    ..*self
                }
                .integer(before) as u64;
                whole & !mask | raw << low & mask
            }
        };
        let mut bytes = vec![0; self.length];
        for (i, byte) in bytes.iter_mut().enumerate() {
            let place = if self.big { self.length - 1 - i } else { i };
            *byte = if place < 8 {
                (raw >> (8 * place)) as u8
            } else {
                0
            };
        }
        bytes
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    const FILE: &str = r#"<?xml version="1.0"?><RegisterDescription>
        <Category Name="Root"><pFeature>Gain</pFeature></Category>
        <Float Name="Gain"><pValue>GainReg</pValue></Float>
        <FloatReg Name="GainReg"><Address>0x100</Address><pIndex Offset="16">Selector</pIndex><Length>4</Length><pPort>Device</pPort></FloatReg>
        <Integer Name="Selector"><Value>2</Value></Integer>
        <Enumeration Name="Mode"><EnumEntry Name="Off"><Value>0</Value></EnumEntry><EnumEntry Name="On"><Value>0x5</Value></EnumEntry><pValue>ModeReg</pValue></Enumeration>
        <MaskedIntReg Name="ModeReg"><Address>0x200</Address><Length>4</Length><LSB>4</LSB><MSB>7</MSB><Endianess>LittleEndian</Endianess></MaskedIntReg>
        <Integer Name="ChunkEncoderValue"><pValue>Enc</pValue></Integer>
        <IntReg Name="Enc"><Address>0</Address><Length>8</Length><Sign>Signed</Sign><pPort>EncPort</pPort></IntReg>
        <Port Name="EncPort"><ChunkID>E0</ChunkID></Port>
        <IntSwissKnife Name="Sum"><pVariable Name="A">Gain</pVariable><Formula>A+1</Formula></IntSwissKnife>
        <Integer Name="Loop"><pValue>Loop</pValue></Integer>
    </RegisterDescription>"#;

    struct Nothing;

    impl Memory for Nothing {
        type Error = DecodeError;
        fn integer(&mut self, _: &Register) -> Result<i64, DecodeError> {
            Ok(3)
        }
    }

    #[test]
    fn features_are_followed_to_their_registers() {
        let features = Features::read(FILE.as_bytes()).expect("a file");
        let place = |name: &str| features.place(name, &mut Nothing);
        let Ok(Place::Register(gain)) = place("Gain") else {
            panic!("{:?}", place("Gain"));
        };
        assert_eq!((gain.address, gain.length, gain.float), (0x120, 4, true));
        assert_eq!(gain.number(&gain.encode(1.5, &[])), 1.5);
        let Ok(Place::Register(mode)) = place("Mode") else {
            panic!("{:?}", place("Mode"));
        };
        assert_eq!(features.entry("Mode", "On"), Some(5));
        assert_eq!(mode.encode(5.0, &[0xFF, 0xFF, 0, 0]), [0x5F, 0xFF, 0, 0]);
        assert_eq!(mode.integer(&[0x5F, 0xFF, 0, 0]), 5);
        let Ok(Place::Register(encoder)) = place("ChunkEncoderValue") else {
            panic!("{:?}", place("ChunkEncoderValue"));
        };
        assert_eq!(encoder.chunk, Some(0xE0));
        assert_eq!(encoder.integer(&(-7_i64).to_le_bytes()), -7);
        assert_eq!(place("Selector"), Ok(Place::Constant(2.0)));
        for (name, why) in [
            ("Sum", "IntSwissKnife"),
            ("Loop", "no such"),
            ("None", "no such"),
        ] {
            let error = place(name).expect_err("nothing").to_string();
            assert!(error.contains(why), "{error}");
        }
    }

    #[test]
    fn an_archive_is_unpacked_within_bounds() {
        let packed = miniz_oxide::deflate::compress_to_vec(FILE.as_bytes(), 6);
        let mut archive = b"PK\x03\x04\x14\0\0\0\x08\0\0\0\0\0\0\0\0\0".to_vec();
        archive.extend((packed.len() as u32).to_le_bytes());
        archive.extend((FILE.len() as u32).to_le_bytes());
        archive.extend([5, 0, 0, 0]);
        archive.extend(b"a.xml");
        archive.extend(&packed);
        archive.extend(b"PK\x01\x02 the directory");
        assert!(
            Features::read(&archive)
                .expect("an archive")
                .contains("Gain")
        );
        for cut in 0..archive.len() - packed.len() {
            assert!(Features::read(&archive[..cut]).is_err());
        }
        // A megabyte of zeros a kilobyte: a bomb of 32 MiB.
        let bomb = miniz_oxide::deflate::compress_to_vec(&vec![b' '; 2 * FILE_MAX], 6);
        archive.truncate(35);
        archive.extend(bomb);
        assert!(Features::read(&archive).is_err());
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            rng_seed: RngSeed::Fixed(24),
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        #[test]
        fn any_file_is_read_or_refused(at in 0..FILE.len(), byte in any::<u8>(), cut in 0..FILE.len()) {
            let mut bytes = FILE.as_bytes().to_vec();
            bytes[at] = byte;
            for file in [&bytes[..], &bytes[..cut]] {
                if let Ok(features) = Features::read(file) {
                    for name in ["Gain", "Mode", "ChunkEncoderValue", "Sum", "Loop"] {
                        let _ = features.place(name, &mut Nothing);
                    }
                }
            }
        }

        #[test]
        fn numbers_come_back(length in 1_usize..=8, big in any::<bool>(), raw in any::<u32>()) {
            let register = Register { address: 0, length, big, signed: false, float: false, bits: None, chunk: None };
            let number = if length < 4 { raw % (1 << (8 * length)) } else { raw };
            prop_assert_eq!(register.integer(&register.encode(number.into(), &[])), i64::from(number));
        }
    }
}

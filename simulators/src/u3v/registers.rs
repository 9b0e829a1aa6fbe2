//! Memory of the simulated USB3 Vision device: bootstrap registers, the GenICam file, and the registers of its features.

use super::{COORD3D_ABC32F, COORD3D_C16, COUNT_MM, PITCH_MM, Setup, columns, middle_mm};

const SBRM: u64 = 0x1_0000;
const SIRM: u64 = 0x2_0000;
const MANIFEST: u64 = 0x3_0000;
const FILE: u64 = 0x4_0000;
const FEATURES: u64 = 0x10_0000;

/// Registers of features, from [`FEATURES`].
const PIXEL_FORMAT: usize = 0x00;
const START: usize = 0x04;
const STOP: usize = 0x08;
const SELECTOR: usize = 0x0C;
const INVALID_FLAG: usize = 0x10;
const INVALID_VALUE: usize = 0x14;
const EXPOSURE: usize = 0x18;
const SCALES: usize = 0x40;
const FEATURES_SIZE: usize = 0x80;

/// Largest transfer of the control channel.
const CONTROL_MAX: u32 = 1024;

pub(super) struct Memory {
    abrm: Vec<u8>,
    sbrm: Vec<u8>,
    sirm: Vec<u8>,
    manifest: Vec<u8>,
    file: Vec<u8>,
    features: Vec<u8>,
    columns: u32,
    lines: u32,
    encoder_bytes: usize,
    middle_mm: f64,
}

fn put(bytes: &mut [u8], at: usize, value: &[u8]) {
    bytes[at..at + value.len()].copy_from_slice(value);
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    bytes[at..at + 4].try_into().map_or(0, u32::from_le_bytes)
}

impl Memory {
    pub fn new(setup: &Setup) -> Memory {
        let xml = genicam(setup.encoder_bytes);
        let file = match setup.zipped {
            true => zip(xml.as_bytes()),
            false => xml.into_bytes(),
        };
        let mut abrm = vec![0; 0x210];
        put(&mut abrm, 0x000, &0x0001_0000_u32.to_le_bytes());
        for (at, text) in [
            (0x004, "Simulated Metrology"),
            (0x044, "U3V line profiler"),
            (0x084, "simulated"),
            (0x0C4, "1.2.3"),
            (0x144, &setup.serial),
        ] {
            put(&mut abrm, at, &text.as_bytes()[..text.len().min(63)]);
        }
        put(&mut abrm, 0x1CC, &100_u32.to_le_bytes());
        put(&mut abrm, 0x1D0, &MANIFEST.to_le_bytes());
        put(&mut abrm, 0x1D8, &SBRM.to_le_bytes());
        let mut sbrm = vec![0; 0x44];
        put(&mut sbrm, 0x00, &0x0001_0000_u32.to_le_bytes());
        put(&mut sbrm, 0x14, &CONTROL_MAX.to_le_bytes());
        put(&mut sbrm, 0x18, &CONTROL_MAX.to_le_bytes());
        put(&mut sbrm, 0x1C, &1_u32.to_le_bytes());
        put(&mut sbrm, 0x20, &SIRM.to_le_bytes());
        put(&mut sbrm, 0x28, &0x30_u32.to_le_bytes());
        let mut sirm = vec![0; 0x30];
        put(&mut sirm, 0x00, &(10_u32 << 24).to_le_bytes()); // sizes are multiples of 2^10
        put(&mut sirm, 0x10, &52_u32.to_le_bytes());
        put(&mut sirm, 0x14, &36_u32.to_le_bytes());
        let mut manifest = 1_u64.to_le_bytes().to_vec();
        manifest.extend([0, 0, 0, 1]);
        manifest.extend((u32::from(setup.zipped) << 10).to_le_bytes());
        manifest.extend(FILE.to_le_bytes());
        let size = setup.misdeeds.lying_file.unwrap_or(file.len() as u64);
        manifest.extend(size.to_le_bytes());
        manifest.resize(8 + 64, 0);
        let mut features = vec![0; FEATURES_SIZE];
        put(&mut features, PIXEL_FORMAT, &COORD3D_C16.to_le_bytes());
        put(&mut features, EXPOSURE, &100_f32.to_le_bytes());
        let mut memory = Memory {
            abrm,
            sbrm,
            sirm,
            manifest,
            file,
            features,
            columns: columns(setup),
            lines: setup.lines,
            encoder_bytes: setup.encoder_bytes,
            middle_mm: middle_mm(setup),
        };
        memory.follow_format();
        memory
    }

    /// What depends on the pixel format: counts for C16, mm for floats; bytes of a block.
    fn follow_format(&mut self) {
        let counts = self.pixel_format() != COORD3D_ABC32F;
        let origin = -0.5 * PITCH_MM * f64::from(self.columns);
        let scales = match counts {
            true => [
                (PITCH_MM, origin),
                (1.0, 0.0),
                (COUNT_MM, self.middle_mm - 32_768.0 * COUNT_MM),
            ],
            false => [(1.0, 0.0); 3],
        };
        for (axis, (scale, offset)) in scales.into_iter().enumerate() {
            put(
                &mut self.features,
                SCALES + 16 * axis,
                &f64::to_le_bytes(scale),
            );
            put(
                &mut self.features,
                SCALES + 16 * axis + 8,
                &f64::to_le_bytes(offset),
            );
        }
        put(
            &mut self.features,
            INVALID_FLAG,
            &u32::from(counts).to_le_bytes(),
        );
        let pixel = if counts { 2 } else { 12 };
        let image = u64::from(self.columns) * u64::from(self.lines) * pixel;
        // Three chunks have a tail each, the time eight bytes, and the encoder its own.
        let payload = image + 3 * 8 + 8 + self.encoder_bytes as u64;
        put(&mut self.sirm, 0x08, &payload.to_le_bytes());
    }

    fn area(&mut self, address: u64) -> Option<(&mut Vec<u8>, usize, bool)> {
        let at = |start: u64| (address - start) as usize;
        Some(match address {
            FEATURES.. => (&mut self.features, at(FEATURES), true),
            FILE.. => (&mut self.file, at(FILE), false),
            MANIFEST.. => (&mut self.manifest, at(MANIFEST), false),
            SIRM.. => (&mut self.sirm, at(SIRM), true),
            SBRM.. => (&mut self.sbrm, at(SBRM), false),
            _ => (&mut self.abrm, at(0), false),
        })
    }

    pub fn read(&mut self, address: u64, count: usize) -> Option<Vec<u8>> {
        let (bytes, at, _) = self.area(address)?;
        bytes.get(at..at.checked_add(count)?).map(<[u8]>::to_vec)
    }

    pub fn write(&mut self, address: u64, data: &[u8]) -> bool {
        let Some((bytes, at, true)) = self.area(address) else {
            return false;
        };
        let Some(place) = bytes.get_mut(at..at + data.len()) else {
            return false;
        };
        place.copy_from_slice(data);
        self.follow_format();
        true
    }

    pub fn pixel_format(&self) -> u32 {
        u32_at(&self.features, PIXEL_FORMAT)
    }

    /// The stream is enabled.
    pub fn streaming(&self) -> bool {
        u32_at(&self.sirm, 0x04) & 1 == 1
    }

    /// The command was written since it was asked for last.
    fn take(&mut self, register: usize) -> bool {
        let set = u32_at(&self.features, register) != 0;
        put(&mut self.features, register, &[0; 4]);
        set
    }

    pub fn take_start(&mut self) -> bool {
        self.take(START)
    }

    pub fn take_stop(&mut self) -> bool {
        self.take(STOP)
    }

    /// Cuts a payload as the host asked for: transfers of one size, then the last ones.
    pub fn transfers(&self, payload: &[u8]) -> Vec<Vec<u8>> {
        let size = |at: usize| u32_at(&self.sirm, at) as usize;
        let mut sizes = vec![size(0x1C); size(0x20).min(1 << 16)];
        sizes.extend([size(0x24), size(0x28)]);
        let mut rest = payload;
        let mut found = Vec::new();
        for size in sizes {
            let n = size.min(rest.len());
            if n > 0 {
                found.push(rest[..n].to_vec());
                rest = &rest[n..];
            }
        }
        found
    }
}

/// The file: every feature with its register, and the ports of the chunks.
fn genicam(encoder_bytes: usize) -> String {
    let mut nodes = String::new();
    let mut add = |text: String| nodes.push_str(&text);
    let address = |offset: usize| format!("0x{:X}", FEATURES + offset as u64);
    add("<Category Name=\"Root\"><pFeature>PixelFormat</pFeature></Category>".into());
    add(format!(
        "<Enumeration Name=\"PixelFormat\"><EnumEntry Name=\"Coord3D_C16\"><Value>{COORD3D_C16}</Value></EnumEntry>\
         <EnumEntry Name=\"Coord3D_ABC32f\"><Value>{COORD3D_ABC32F}</Value></EnumEntry><pValue>PixelFormatReg</pValue></Enumeration>"
    ));
    add(int_reg(
        "PixelFormatReg",
        &address(PIXEL_FORMAT),
        4,
        "Device",
        false,
    ));
    for (name, offset) in [("AcquisitionStart", START), ("AcquisitionStop", STOP)] {
        add(format!(
            "<Command Name=\"{name}\"><pValue>{name}Reg</pValue><CommandValue>1</CommandValue></Command>"
        ));
        add(int_reg(
            &format!("{name}Reg"),
            &address(offset),
            4,
            "Device",
            false,
        ));
    }
    add("<Enumeration Name=\"Scan3dCoordinateSelector\">".into());
    for (value, axis) in ["A", "B", "C"].iter().enumerate() {
        add(format!(
            "<EnumEntry Name=\"Coordinate{axis}\"><Value>{value}</Value></EnumEntry>"
        ));
    }
    add("<pValue>SelectorReg</pValue></Enumeration>".into());
    add(int_reg(
        "SelectorReg",
        &address(SELECTOR),
        4,
        "Device",
        false,
    ));
    for (name, offset) in [
        ("Scan3dCoordinateScale", SCALES),
        ("Scan3dCoordinateOffset", SCALES + 8),
    ] {
        add(format!(
            "<Float Name=\"{name}\"><pValue>{name}Reg</pValue></Float><FloatReg Name=\"{name}Reg\"><Address>{}</Address>\
             <pIndex Offset=\"16\">SelectorReg</pIndex><Length>8</Length><AccessMode>RO</AccessMode><pPort>Device</pPort>\
             <Endianess>LittleEndian</Endianess></FloatReg>",
            address(offset)
        ));
    }
    add("<Boolean Name=\"Scan3dInvalidDataFlag\"><pValue>InvalidFlagReg</pValue><OnValue>1</OnValue><OffValue>0</OffValue></Boolean>".into());
    add(int_reg(
        "InvalidFlagReg",
        &address(INVALID_FLAG),
        4,
        "Device",
        false,
    ));
    for (name, offset) in [
        ("Scan3dInvalidDataValue", INVALID_VALUE),
        ("ExposureTime", EXPOSURE),
    ] {
        add(format!(
            "<Float Name=\"{name}\"><pValue>{name}Reg</pValue></Float><FloatReg Name=\"{name}Reg\"><Address>{}</Address>\
             <Length>4</Length><pPort>Device</pPort><Endianess>LittleEndian</Endianess></FloatReg>",
            address(offset)
        ));
    }
    let encoder = ("ChunkEncoderValue", "E0", encoder_bytes as u32);
    for (name, id, length) in [encoder, ("ChunkTimestamp", "E1", 8)] {
        add(format!(
            "<Integer Name=\"{name}\"><pValue>{name}Reg</pValue></Integer><Port Name=\"{name}Port\"><ChunkID>{id}</ChunkID></Port>"
        ));
        add(int_reg(
            &format!("{name}Reg"),
            "0x0",
            length,
            &format!("{name}Port"),
            true,
        ));
    }
    add(
        "<Integer Name=\"Derived\"><pValue>DerivedSwissKnife</pValue></Integer>\
         <IntSwissKnife Name=\"DerivedSwissKnife\"><Formula>1+1</Formula></IntSwissKnife>"
            .into(),
    );
    format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<RegisterDescription ModelName=\"U3V line profiler\">{nodes}</RegisterDescription>\n"
    )
}

fn int_reg(name: &str, address: &str, length: u32, port: &str, signed: bool) -> String {
    let sign = if signed { "Signed" } else { "Unsigned" };
    format!(
        "<IntReg Name=\"{name}\"><Address>{address}</Address><Length>{length}</Length><AccessMode>RW</AccessMode>\
         <pPort>{port}</pPort><Sign>{sign}</Sign><Endianess>LittleEndian</Endianess></IntReg>"
    )
}

/// An archive of one file, as PKWARE's note lays it out: local header and data; nothing reads the directory.
fn zip(bytes: &[u8]) -> Vec<u8> {
    const NAME: &[u8] = b"u3v.xml";
    let data = miniz_oxide::deflate::compress_to_vec(bytes, 6);
    let mut archive = b"PK\x03\x04\x14\0\0\0\x08\0".to_vec();
    archive.extend([0; 8]); // time, date, CRC: not looked at
    archive.extend((data.len() as u32).to_le_bytes());
    archive.extend((bytes.len() as u32).to_le_bytes());
    archive.extend((NAME.len() as u16).to_le_bytes());
    archive.extend([0; 2]);
    archive.extend(NAME);
    archive.extend(data);
    archive
}

//! A Mitutoyo USB-ITN input tool with a gauge on it, 0fe7:4001, played from what is published of its raw mode: a vendor request that switches
//! it over, one that asks for a byte, and readings that are asked for by control and come on the interrupt endpoint.

use std::collections::VecDeque;

use crate::usb::{Model, Outcome};

/// How a reading is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// `01A-001.2340` and CR.
    Text,
    /// 13 hex digits: the nibbles of the Digimatic frame.
    Nibbles,
}

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Misdeeds {
    /// Readings that do not come, one in so many.
    pub mute_every: Option<u32>,
    /// Readings that are rubbish, one in so many.
    pub garble_every: Option<u32>,
    /// The switch-over request is refused.
    pub refuse: bool,
    /// The interrupt endpoint halts at this reading, from 0.
    pub stall_at: Option<u32>,
}

/// The tool and its gauge.
#[derive(Debug, Clone)]
pub struct InputTool {
    /// Serial number of the tool.
    pub serial: String,
    /// How readings are written.
    pub form: Form,
    /// Number behind the point, 0 to 5.
    pub decimals: u32,
    /// What the gauge shows, in units of the last decimal, one after the other and again.
    pub readings: Vec<i32>,
    /// What goes wrong.
    pub misdeeds: Misdeeds,
    /// The raw mode is on.
    pub raw: bool,
    /// Readings asked for.
    pub asked: u32,
    queue: VecDeque<Vec<u8>>,
}

impl InputTool {
    /// A tool in good order.
    pub fn new(serial: &str, readings: Vec<i32>) -> InputTool {
        InputTool {
            serial: serial.to_owned(),
            form: Form::Text,
            decimals: 3,
            readings,
            misdeeds: Misdeeds::default(),
            raw: false,
            asked: 0,
            queue: VecDeque::new(),
        }
    }

    /// The button on the gauge is pressed: a reading comes unasked.
    pub fn press(&mut self) {
        let reading = self.reading(self.asked);
        self.queue.push_back(reading);
    }

    fn reading(&self, index: u32) -> Vec<u8> {
        let value = self.readings[index as usize % self.readings.len()];
        let text = match self.form {
            Form::Text => {
                let sign = if value < 0 { '-' } else { '+' };
                let scale = 10_u32.pow(self.decimals);
                let (whole, part) = (value.unsigned_abs() / scale, value.unsigned_abs() % scale);
                let digits = self.decimals as usize;
                let number = format!("{whole}.{part:0digits$}");
                format!("01A{sign}{number:0>8}\r")
            }
            Form::Nibbles => {
                let sign = if value < 0 { '8' } else { '0' };
                format!(
                    "FFFF{sign}{:06}{}0",
                    value.unsigned_abs() % 1_000_000,
                    self.decimals
                )
            }
        };
        let mut bytes = text.into_bytes();
        bytes.resize(64, 0);
        bytes
    }
}

impl Model for InputTool {
    fn device_descriptor(&self) -> Vec<u8> {
        vec![
            18, 1, 0, 2, 0, 0, 0, 64, 0xE7, 0x0F, 0x01, 0x40, 0, 1, 1, 2, 3, 1,
        ]
    }

    fn configuration_descriptor(&self) -> Vec<u8> {
        let mut bytes = vec![9, 2, 25, 0, 1, 1, 0, 0x80, 50];
        bytes.extend([9, 4, 0, 0, 1, 3, 0, 0, 0]); // one HID interface
        bytes.extend([7, 5, 0x81, 3, 64, 0, 10]);
        bytes
    }

    fn strings(&self) -> Vec<String> {
        ["Mitutoyo", "USB-ITN (simulated)", &self.serial]
            .map(str::to_owned)
            .to_vec()
    }

    fn control(&mut self, setup: [u8; 8], data: &[u8]) -> Outcome {
        match (setup[0], setup[1]) {
            (0x40, 1) if self.misdeeds.refuse => Outcome::Stall,
            (0x40, 1) if setup[2..4] == [0xA5, 0xA5] => {
                self.raw = true;
                Outcome::Accepted(0)
            }
            (0xC0, 2) if self.raw => Outcome::Data(vec![0]),
            (0x40, 3) if self.raw && data == b"1\r" => {
                let index = self.asked;
                self.asked += 1;
                let now = |every: Option<u32>| every.is_some_and(|n| index % n == n - 1);
                if now(self.misdeeds.garble_every) {
                    self.queue.push_back(b"\xFF\x00gauge?".to_vec());
                } else if !now(self.misdeeds.mute_every) {
                    let reading = self.reading(index);
                    self.queue.push_back(reading);
                }
                Outcome::Accepted(data.len())
            }
            (0x00, 9) => Outcome::Accepted(0),
            _ => Outcome::Stall,
        }
    }

    fn output(&mut self, _: u8, _: &[u8]) -> Outcome {
        Outcome::Stall
    }

    fn input(&mut self, endpoint: u8, most: usize) -> Outcome {
        if endpoint != 0x81 {
            return Outcome::Stall;
        }
        if self.misdeeds.stall_at.is_some_and(|at| self.asked > at) {
            self.misdeeds.stall_at = None;
            self.queue.clear();
            return Outcome::Stall;
        }
        match self.queue.pop_front() {
            Some(mut bytes) => {
                bytes.truncate(most);
                Outcome::Data(bytes)
            }
            None => Outcome::Nak,
        }
    }

    fn powered(&mut self) {
        self.raw = false;
        self.queue.clear();
    }
}

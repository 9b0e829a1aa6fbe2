//! One table of a configuration, read key by key, so that all its mistakes are told at once.
//!
//! A derived reader stops at the first wrong key. Here every key that is asked for is remembered, and what was not asked for is
//! unknown.

use std::fmt;
use std::ops::RangeInclusive;

use toml::Value;

use crate::device::Mistake;
use crate::link::{Line, Port, Target};

/// A table being read. Every reading method answers `None` where the key is absent or wrong; the latter is noted.
#[derive(Debug)]
pub struct Keys {
    table: toml::Table,
    known: Vec<&'static str>,
    mistakes: Vec<Mistake>,
}

impl Keys {
    /// A table of which nothing has been read.
    pub fn new(table: toml::Table) -> Keys {
        Keys {
            table,
            known: Vec::new(),
            mistakes: Vec::new(),
        }
    }

    /// Adds a mistake.
    pub fn wrong(&mut self, key: &str, found: impl fmt::Display, expected: &str) {
        self.mistakes.push(Mistake {
            key: key.into(),
            found: found.to_string(),
            expected: expected.into(),
        });
    }

    fn value(&mut self, key: &'static str) -> Option<Value> {
        self.known.push(key);
        self.table.remove(key)
    }

    /// What `read` makes of `key`, which must be there.
    pub fn needed<T>(
        &mut self,
        key: &'static str,
        expected: &str,
        read: impl FnOnce(&mut Keys, &'static str) -> Option<T>,
    ) -> Option<T> {
        if !self.table.contains_key(key) {
            self.known.push(key);
            self.wrong(key, "nothing", expected);
            return None;
        }
        read(self, key)
    }

    /// Whether there is such a key.
    pub fn contains(&self, key: &str) -> bool {
        self.table.contains_key(key)
    }

    /// The table under `key`.
    pub fn table(&mut self, key: &'static str) -> Option<toml::Table> {
        match self.value(key)? {
            Value::Table(table) => Some(table),
            other => {
                self.wrong(key, shown(&other), &format!("a table [{key}]"));
                None
            }
        }
    }

    /// The tables of the array under `key`; none where it is absent.
    pub fn tables(&mut self, key: &'static str) -> Vec<toml::Table> {
        let Some(value) = self.value(key) else {
            return Vec::new();
        };
        let entries = value.as_array().map(Vec::as_slice).unwrap_or_default();
        let tables: Vec<toml::Table> = entries
            .iter()
            .filter_map(|entry| entry.as_table().cloned())
            .collect();
        if tables.len() != entries.len() || !value.is_array() {
            self.wrong(key, shown(&value), &format!("tables, each under [[{key}]]"));
            return Vec::new();
        }
        tables
    }

    /// Takes over the mistakes of a table that stood under `key`; true where there were none.
    pub fn adopt(&mut self, key: &str, inner: Keys) -> bool {
        let mistakes = inner.finish().err().unwrap_or_default();
        let sound = mistakes.is_empty();
        self.mistakes
            .extend(mistakes.into_iter().map(|inner| Mistake {
                key: format!("{key}.{}", inner.key),
                ..inner
            }));
        sound
    }

    /// What was not asked for, and the mistakes so far: for a table that two readers share.
    pub fn into_rest(self) -> (toml::Table, Vec<Mistake>) {
        (self.table, self.mistakes)
    }

    /// The text under `key`, not empty.
    pub fn text(&mut self, key: &'static str) -> Option<String> {
        match self.value(key)? {
            Value::String(text) if !text.trim().is_empty() => Some(text),
            other => {
                self.wrong(key, shown(&other), "a text that is not empty");
                None
            }
        }
    }

    /// The number under `key`, inside `range`.
    pub fn number(&mut self, key: &'static str, range: RangeInclusive<f64>) -> Option<f64> {
        let value = self.value(key)?;
        match number(&value).filter(|number| range.contains(number)) {
            Some(number) => Some(number),
            None => {
                let expected = format!("a number of {} to {}", range.start(), range.end());
                self.wrong(key, shown(&value), &expected);
                None
            }
        }
    }

    /// The whole number under `key`, inside `range`.
    pub fn integer(&mut self, key: &'static str, range: RangeInclusive<i64>) -> Option<i64> {
        match self.value(key)? {
            Value::Integer(number) if range.contains(&number) => Some(number),
            other => {
                let expected = format!("a whole number of {} to {}", range.start(), range.end());
                self.wrong(key, shown(&other), &expected);
                None
            }
        }
    }

    /// The truth value under `key`.
    pub fn flag(&mut self, key: &'static str) -> Option<bool> {
        match self.value(key)? {
            Value::Boolean(flag) => Some(flag),
            other => {
                self.wrong(key, shown(&other), "true or false");
                None
            }
        }
    }

    /// One of the words of `choices` under `key`.
    pub fn choice<T: Copy>(&mut self, key: &'static str, choices: &[(&str, T)]) -> Option<T> {
        let value = self.value(key)?;
        let found = choices
            .iter()
            .find(|(word, _)| value.as_str() == Some(word));
        if found.is_none() {
            let words: Vec<String> = choices
                .iter()
                .map(|(word, _)| format!("{word:?}"))
                .collect();
            self.wrong(key, shown(&value), &words.join(" or "));
        }
        found.map(|(_, choice)| *choice)
    }

    /// What stands in `choices` beside the whole number under `key`.
    pub fn choice_of_numbers<T: Copy>(
        &mut self,
        key: &'static str,
        choices: &[(i64, T)],
    ) -> Option<T> {
        let numbers: Vec<String> = choices.iter().map(|(n, _)| n.to_string()).collect();
        self.read(key, &numbers.join(" or "), |value| {
            let number = value.as_integer()?;
            let found = choices.iter().find(|(choice, _)| *choice == number);
            found.map(|(_, choice)| *choice)
        })
    }

    /// Three finite numbers under `key`.
    pub fn vector(&mut self, key: &'static str) -> Option<[f64; 3]> {
        self.read(key, "three numbers, as in [0.0, 0.0, -50.0]", numbers)
    }

    /// What `read` makes of the value under `key`; a value of which it makes nothing is wrong.
    pub fn read<T>(
        &mut self,
        key: &'static str,
        expected: &str,
        read: impl FnOnce(&Value) -> Option<T>,
    ) -> Option<T> {
        let value = self.value(key)?;
        let found = read(&value);
        if found.is_none() {
            self.wrong(key, shown(&value), expected);
        }
        found
    }

    /// The link under `port`, `usb_serial`, `usb_id` or `address`, with `baud`.
    pub fn target(&mut self, default_baud: u32) -> Option<Target> {
        const NAMES: [&str; 4] = ["port", "usb_serial", "usb_id", "address"];
        let given: Vec<&str> = NAMES
            .into_iter()
            .filter(|name| self.table.contains_key(*name))
            .collect();
        if given.len() != 1 {
            let found = match given.len() {
                0 => "no link".into(),
                _ => format!("{} together", given.join(" and ")),
            };
            self.wrong(
                "port",
                found,
                "exactly one of port, usb_serial, usb_id, address",
            );
        }
        let baud = self.integer("baud", 300..=12_000_000);
        if let (Some(baud), ["address"]) = (baud, given.as_slice()) {
            self.wrong("baud", baud, "none, for a link by address");
        }
        // The range above fits.
        let line = Line::eight_n_one(baud.map_or(default_baud, |baud| baud as u32));
        let [port, usb_serial, usb_id, address] = NAMES.map(|name| self.text(name));
        let usb_id = usb_id.and_then(|text| self.usb_id(&text));
        if let Some(text) = address.as_ref().filter(|text| !has_port_number(text)) {
            self.wrong(
                "address",
                format!("{text:?}"),
                "host:port, as in \"192.168.1.20:7450\"",
            );
        }
        let port = port
            .map(Port::Path)
            .or(usb_serial.map(Port::UsbSerial))
            .or(usb_id);
        port.map(|port| Target::Serial { port, line })
            .or(address.map(|address| Target::Tcp { address }))
    }

    /// Host and port under `key`, written `host` or `host:port`; without a port it is `default_port`.
    pub fn host_and_port(&mut self, key: &'static str, default_port: u16) -> Option<(String, u16)> {
        let expected = "a host, or host:port, as in \"192.168.1.10\"";
        self.needed(key, expected, |keys, key| {
            let text = keys.text(key)?;
            if has_port_number(&text) {
                let (host, port) = text.rsplit_once(':')?;
                return Some((host.into(), port.parse().ok()?));
            }
            if text.contains(':') && !text.ends_with(']') {
                keys.wrong(key, format!("{text:?}"), expected);
                return None;
            }
            Some((text, default_port))
        })
    }

    /// Vendor and product number of a USB device under `key`.
    pub fn usb_id_under(&mut self, key: &'static str) -> Option<(u16, u16)> {
        let text = self.text(key)?;
        match self.usb_id(&text)? {
            Port::UsbId { vendor, product } => Some((vendor, product)),
            _ => None,
        }
    }

    fn usb_id(&mut self, text: &str) -> Option<Port> {
        let number = |digits: &str| {
            let hex = digits.len() <= 4 && digits.bytes().all(|b| b.is_ascii_hexdigit());
            hex.then(|| u16::from_str_radix(digits, 16).ok()).flatten()
        };
        let port = text.split_once(':').and_then(|(vendor, product)| {
            Some(Port::UsbId {
                vendor: number(vendor)?,
                product: number(product)?,
            })
        });
        if port.is_none() {
            let expected = "vendor:product in hex, as in \"0403:6001\"";
            self.wrong("usb_id", format!("{text:?}"), expected);
        }
        port
    }

    /// Ends the reading: every key not asked for is unknown.
    ///
    /// # Errors
    /// All mistakes of the table.
    pub fn finish(mut self) -> Result<(), Vec<Mistake>> {
        let left: Vec<String> = self.table.keys().cloned().collect();
        let known = format!("one of {}", self.known.join(", "));
        for key in left {
            self.wrong(&key, "an unknown key", &known);
        }
        if self.mistakes.is_empty() {
            Ok(())
        } else {
            Err(self.mistakes)
        }
    }
}

/// The finite number that `value` is, written whole or not.
pub fn number(value: &Value) -> Option<f64> {
    let number = match value {
        Value::Float(number) => *number,
        Value::Integer(number) => *number as f64,
        _ => return None,
    };
    number.is_finite().then_some(number)
}

/// The `N` finite numbers that `value` is an array of.
pub fn numbers<const N: usize>(value: &Value) -> Option<[f64; N]> {
    let numbers: Option<Vec<f64>> = value.as_array()?.iter().map(number).collect();
    numbers?.try_into().ok()
}

/// A value as written, shortened.
fn shown(value: &Value) -> String {
    const SHOWN: usize = 60;
    let text = value.to_string();
    match text.char_indices().nth(SHOWN) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text,
    }
}

fn has_port_number(address: &str) -> bool {
    address.rsplit_once(':').is_some_and(|(host, port)| {
        !host.is_empty() && port.parse::<u16>().is_ok_and(|port| port != 0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::Claim;

    fn read(text: &str) -> (Option<Target>, Vec<String>) {
        let mut keys = Keys::new(toml::from_str(text).expect("the test's TOML"));
        let target = keys.target(921_600);
        let mistakes = keys.finish().err().unwrap_or_default();
        (target, mistakes.iter().map(Mistake::to_string).collect())
    }

    #[test]
    fn link_keys_name_one_target() {
        let (target, mistakes) = read("usb_id = '0403:6001'\nbaud = 115200");
        assert!(mistakes.is_empty());
        let port = Port::UsbId {
            vendor: 0x0403,
            product: 0x6001,
        };
        let line = Line::eight_n_one(115_200);
        assert_eq!(target, Some(Target::Serial { port, line }));
        let claim = target.map(|target| target.claim());
        assert_eq!(claim, Some(Claim::Port("usb:0403:6001".into())));

        let (target, _) = read("address = '[::1]:7450'");
        let address = "[::1]:7450".to_owned();
        assert_eq!(target, Some(Target::Tcp { address }));
    }

    #[test]
    fn every_mistake_of_the_link_is_told() {
        let told = |text| read(text).1;
        let one = "expected exactly one of port, usb_serial, usb_id, address";
        assert_eq!(told(""), [format!("port: no link, {one}")]);
        assert_eq!(
            told("port = '/dev/ttyACM0'\naddress = 'nowhere'\nbaud = 10\nprot = 1"),
            [
                format!("port: port and address together, {one}"),
                "baud: 10, expected a whole number of 300 to 12000000".into(),
                "address: \"nowhere\", expected host:port, as in \"192.168.1.20:7450\"".into(),
                "prot: an unknown key, expected one of baud, port, usb_serial, usb_id, address"
                    .into(),
            ]
        );
        assert_eq!(
            told("address = 'a:1'\nbaud = 9600"),
            ["baud: 9600, expected none, for a link by address"]
        );
        assert_eq!(
            told("usb_id = '0403-6001'"),
            ["usb_id: \"0403-6001\", expected vendor:product in hex, as in \"0403:6001\""]
        );
        assert_eq!(
            told("usb_serial = ' '"),
            ["usb_serial: \" \", expected a text that is not empty"]
        );
    }
}

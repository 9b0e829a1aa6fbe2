//! The table `[service]`: how the daemon serves the cell. All of it has defaults.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use acies_drivers::device::Mistake;
use acies_drivers::settings::Keys;

use super::mistake;
use crate::store::{Retention, Role};

/// A day, s.
const DAY_S: f64 = 86_400.0;

/// How the daemon serves the cell.
#[derive(Debug, Clone, PartialEq)]
pub struct Service {
    /// The folder of the store.
    pub store: PathBuf,
    /// Where the page and the API are.
    pub address: SocketAddr,
    /// Certificate chain and private key, both PEM; without them the service speaks plain HTTP.
    pub tls: Option<(PathBuf, PathBuf)>,
    /// What somebody may do who has not logged in.
    pub anonymous: Option<Role>,
    /// How many triggers may wait.
    pub queue_limit: usize,
    /// Whether the instruments are simulated.
    pub simulated: bool,
    /// Which raw data are kept.
    pub retention: Retention,
}

/// Reads `[service]`; `beside` makes a path that is given relative to the configuration's folder absolute.
pub(super) fn service(
    table: Option<toml::Table>,
    beside: &dyn Fn(&str) -> PathBuf,
) -> (Service, Vec<Mistake>) {
    let mut keys = Keys::new(table.unwrap_or_default());
    let store = keys.text("store").unwrap_or_else(|| "./store".to_owned());
    let text = keys
        .text("address")
        .unwrap_or_else(|| "127.0.0.1:8370".to_owned());
    let certificate = keys.text("certificate");
    let key = keys.text("private_key");
    let roles = [("operator", Some(Role::Operator)), ("nobody", None)];
    let login = keys.choice("anonymous", &roles);
    let queue_limit = keys.integer("queue_limit", 0..=1000).unwrap_or(8) as usize;
    let simulated = keys.flag("simulated").unwrap_or(false);
    let days = |days: f64| Duration::from_secs_f64(days * DAY_S);
    let gigabytes = |gigabytes: f64| (gigabytes * 1e9) as u64;
    let standard = Retention::default();
    let retention = Retention {
        scans_for: keys.number("keep_scans_days", 0.0..=36_500.0).map(days),
        ok_scans_for: keys.number("keep_ok_scans_days", 0.0..=36_500.0).map(days),
        scans_at_most: keys
            .number("keep_scans_gb", 0.0..=1e6)
            .map_or(standard.scans_at_most, gigabytes),
        free_at_least: keys
            .number("keep_free_gb", 0.0..=1e6)
            .map_or(standard.free_at_least, gigabytes),
    };
    let mut mistakes = keys.finish().err().unwrap_or_default();
    let address = text.parse::<SocketAddr>().unwrap_or_else(|_| {
        let found = format!("{text:?}");
        mistakes.push(mistake(
            "address",
            &found,
            "an address and a port, as in \"127.0.0.1:8370\"",
        ));
        SocketAddr::from(([127, 0, 0, 1], 8370))
    });
    let tls = match (certificate, key) {
        (Some(certificate), Some(key)) => Some((beside(&certificate), beside(&key))),
        (None, None) => None,
        _ => {
            mistakes.push(mistake(
                "certificate",
                "one of two",
                "certificate and private_key, or neither",
            ));
            None
        }
    };
    let loopback = address.ip().is_loopback();
    if !loopback && tls.is_none() && mistakes.is_empty() {
        mistakes.push(mistake(
            "address",
            &format!("{address} without a certificate"),
            "certificate and private_key for an address that others can reach: passwords would be readable on the way",
        ));
    }
    // Who stands at the machine may press Start; who comes over the network says who they are.
    let anonymous = login.unwrap_or_else(|| loopback.then_some(Role::Operator));
    let service = Service {
        store: beside(&store),
        address,
        tls,
        anonymous,
        queue_limit,
        simulated,
        retention,
    };
    (service, mistakes)
}

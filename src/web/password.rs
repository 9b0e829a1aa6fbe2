//! Passwords and keys: slow hashes, random secrets, and a limit on how often somebody may guess.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use argon2::password_hash::phc::PasswordHash;
use argon2::password_hash::{PasswordHasher, PasswordVerifier};
use argon2::{Algorithm, Argon2, Params, Version};
use base64::Engine as _;

/// Shortest password, in characters: OWASP ASVS 5.0, 6.2.1.
///
/// We differ: NIST SP 800-63B-4, 3.1.1.2 asks for 15 where a password is all that is asked. Guesses at a cell are limited, and what is
/// typed beside a machine many times a day is written on a note when it is long.
const SHORTEST: usize = 8;
/// Longest password, in characters: more costs time and adds nothing.
const LONGEST: usize = 256;

/// Failed logins that are free, by name and by address; a mistyped password is no attack.
const FREE: u32 = 5;
/// After so long without another one they are forgotten.
const FORGOTTEN: Duration = Duration::from_secs(60);
/// Names and addresses remembered; beyond that the oldest goes.
const REMEMBERED: usize = 4096;

/// What is wrong with a password or a name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PasswordError {
    /// Too short or too long.
    #[error(
        "the password has {found} characters, expected {SHORTEST} to {LONGEST}; choose a sentence"
    )]
    Length {
        /// Its length.
        found: usize,
    },
    /// The name of somebody cannot be used.
    #[error("{name:?} is no name, expected 1 to 64 characters, none of them a control character")]
    Name {
        /// What was given.
        name: String,
    },
    /// Hashing failed.
    #[error("the password cannot be hashed: {0}; the system has no random numbers or no memory")]
    Hash(String),
}

/// OWASP's first choice: Argon2id, 19 MiB, two passes, one lane (Password Storage Cheat Sheet, section Argon2id).
fn argon2() -> Argon2<'static> {
    let params = Params::new(19 * 1024, 2, 1, None).unwrap_or(Params::DEFAULT);
    Argon2::new(Algorithm::Argon2id, Version::V0x13, params)
}

/// The hash of a new password, to be kept.
///
/// # Errors
/// [`PasswordError::Length`] and [`PasswordError::Hash`].
pub fn hash_password(password: &str) -> Result<String, PasswordError> {
    let found = password.chars().count();
    if !(SHORTEST..=LONGEST).contains(&found) {
        return Err(PasswordError::Length { found });
    }
    let hashed = argon2().hash_password(password.as_bytes());
    hashed
        .map(|hash| hash.to_string())
        .map_err(|error| PasswordError::Hash(error.to_string()))
}

/// A name that may be given to somebody.
///
/// # Errors
/// [`PasswordError::Name`].
pub fn check_name(name: &str) -> Result<(), PasswordError> {
    let fits = (1..=64).contains(&name.chars().count())
        && !name.chars().any(char::is_control)
        && name.trim() == name;
    // These names are written into the audit log by the daemon itself.
    if !fits || ["system", "anonymous", "configuration", "command line"].contains(&name) {
        return Err(PasswordError::Name {
            name: name.to_owned(),
        });
    }
    Ok(())
}

/// Whether `password` is the one behind `hash`. Without a hash the same work is done, so that the time tells nobody which names
/// are known.
pub(super) fn verify(password: &str, hash: Option<&str>) -> bool {
    static NOBODY: OnceLock<String> = OnceLock::new();
    let stand_in = NOBODY.get_or_init(|| hash_password("nobody has this").unwrap_or_default());
    let known = hash.is_some();
    let parsed = PasswordHash::new(hash.unwrap_or(stand_in));
    let Ok(parsed) = parsed else {
        return false;
    };
    // Of what is longer than any password there is, no more than that is looked at.
    let password = &password.as_bytes()[..password.len().min(4 * LONGEST + 1)];
    let right = argon2().verify_password(password, &parsed).is_ok();
    right && known
}

/// A secret of 32 random bytes as text.
///
/// # Errors
/// Where the system has no random numbers.
pub(super) fn secret() -> Result<String, getrandom::Error> {
    let mut bytes = [0; 32];
    getrandom::fill(&mut bytes)?;
    Ok(base64::engine::general_purpose::URL_SAFE_NO_PAD.encode(bytes))
}

/// Who failed to log in lately.
#[derive(Debug, Default)]
pub(super) struct Guesses {
    failed: Mutex<HashMap<String, (u32, Instant)>>,
}

impl Guesses {
    /// How long somebody has to wait before the next guess; nothing where they need not.
    pub fn wait(&self, name: &str, address: IpAddr, now: Instant) -> Option<Duration> {
        let failed = self.failed.lock().unwrap_or_else(PoisonError::into_inner);
        keys(name, address)
            .iter()
            .filter_map(|key| failed.get(key))
            .filter(|(count, last)| *count >= FREE && now.duration_since(*last) < FORGOTTEN)
            .map(|(_, last)| FORGOTTEN - now.duration_since(*last))
            .max()
    }

    /// Notes a guess before it is tried, so that many at once do not slip through.
    pub fn note(&self, name: &str, address: IpAddr, now: Instant) {
        let mut failed = self.failed.lock().unwrap_or_else(PoisonError::into_inner);
        failed.retain(|_, (_, last)| now.duration_since(*last) < FORGOTTEN);
        for key in keys(name, address) {
            if failed.len() >= REMEMBERED
                && let Some(oldest) = failed.iter().min_by_key(|(_, (_, last))| *last)
            {
                let oldest = oldest.0.clone();
                failed.remove(&oldest);
            }
            let entry = failed.entry(key).or_insert((0, now));
            *entry = (entry.0 + 1, now);
        }
    }

    /// Forgets the guesses of somebody who got in.
    pub fn forget(&self, name: &str, address: IpAddr) {
        let mut failed = self.failed.lock().unwrap_or_else(PoisonError::into_inner);
        for key in keys(name, address) {
            failed.remove(&key);
        }
    }
}

/// A name is cut: what nobody is called need not be remembered in full.
fn keys(name: &str, address: IpAddr) -> [String; 2] {
    [
        format!("name {}", name.chars().take(64).collect::<String>()),
        format!("address {address}"),
    ]
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    #[test]
    fn a_hash_is_argon2id_with_the_advised_cost_and_knows_its_password() {
        let hash = hash_password("correct horse").expect("a password of 13 characters");
        assert!(
            hash.starts_with("$argon2id$v=19$m=19456,t=2,p=1$"),
            "{hash}"
        );
        assert!(verify("correct horse", Some(&hash)));
        assert!(!verify("correct horsf", Some(&hash)));
        assert!(
            !verify("nobody has this", None),
            "the stand-in opens nothing"
        );
        assert_eq!(
            hash_password("short"),
            Err(PasswordError::Length { found: 5 })
        );
        // Four characters are four, however many bytes.
        assert_eq!(
            hash_password("𝔪𝔢𝔰𝔰"),
            Err(PasswordError::Length { found: 4 })
        );
        let longest = "𝔪".repeat(LONGEST);
        let hash = hash_password(&longest).expect("as long as it may be");
        assert!(verify(&longest, Some(&hash)));
        assert!(!verify(&(longest + "𝔪"), Some(&hash)));
    }

    #[test]
    fn the_sixth_guess_waits_a_minute() {
        let guesses = Guesses::default();
        let here = IpAddr::V4(Ipv4Addr::LOCALHOST);
        let start = Instant::now();
        for _ in 0..FREE {
            assert_eq!(guesses.wait("ada", here, start), None);
            guesses.note("ada", here, start);
        }
        assert_eq!(guesses.wait("ada", here, start), Some(FORGOTTEN));
        let elsewhere = IpAddr::V4(Ipv4Addr::new(192, 0, 2, 1));
        assert!(guesses.wait("ada", elsewhere, start).is_some(), "by name");
        assert!(guesses.wait("bob", here, start).is_some(), "by address");
        assert_eq!(guesses.wait("bob", elsewhere, start), None);
        assert_eq!(guesses.wait("ada", here, start + FORGOTTEN), None);
    }
}

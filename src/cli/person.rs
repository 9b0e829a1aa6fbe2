//! `acies person`: those who may use a cell's page, written straight into its store.

use std::io::{IsTerminal, Read};
use std::path::PathBuf;
use std::time::SystemTime;

use anyhow::{Context, anyhow};

use super::serve::read_cell;
use super::{Failure, Status, print_line};
use crate::store::{Audit, Role, Store, StoreError};
use crate::web;

/// Longest password that is read from a pipe, bytes: more is no password.
const PIPED_MAX: u64 = 4096;

/// Adds, lists or disables those who may use a cell's page.
///
/// Works beside a running daemon. The password is typed at the terminal, or comes as one line from standard input.
#[derive(Debug, clap::Args)]
pub struct People {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    /// Add somebody.
    Add {
        /// The name to log in with.
        name: String,
        /// What they may do.
        #[arg(long, value_enum)]
        role: RoleArgument,
        #[command(flatten)]
        place: Place,
    },
    /// Give somebody a new password; all their sessions and tokens end.
    Password {
        /// The name.
        name: String,
        #[command(flatten)]
        place: Place,
    },
    /// List everybody.
    List {
        #[command(flatten)]
        place: Place,
        /// Print one JSON object on standard output.
        #[arg(long)]
        json: bool,
    },
    /// Let somebody log in no more; all their sessions and tokens end.
    Disable {
        /// The name.
        name: String,
        #[command(flatten)]
        place: Place,
    },
    /// Let somebody log in again.
    Enable {
        /// The name.
        name: String,
        #[command(flatten)]
        place: Place,
    },
}

/// Whose page.
#[derive(Debug, clap::Args)]
struct Place {
    /// The cell's configuration.
    #[arg(long, value_name = "CELL.toml", default_value = "cell.toml")]
    cell: PathBuf,
}

/// A role on the command line.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum RoleArgument {
    /// Starts, stops, looks.
    Operator,
    /// Prepares recipes, activates those that were in force before.
    Setter,
    /// Puts limits and decision rules in force, sees the audit log.
    Metrologist,
    /// Adds people, makes backups.
    Administrator,
}

impl From<RoleArgument> for Role {
    fn from(role: RoleArgument) -> Self {
        match role {
            RoleArgument::Operator => Role::Operator,
            RoleArgument::Setter => Role::Setter,
            RoleArgument::Metrologist => Role::Metrologist,
            RoleArgument::Administrator => Role::Administrator,
        }
    }
}

impl People {
    /// Carries the command out.
    ///
    /// # Errors
    /// When the cell's configuration has mistakes, the store cannot be opened, or name or password cannot be used.
    pub fn run(self) -> Result<Status, Failure> {
        match self.what {
            What::Add { name, role, place } => {
                web::check_name(&name).map_err(|error| Failure::Usage(error.into()))?;
                let store = place.store()?;
                let hash = ask_password(&name)?;
                let role = Role::from(role);
                let added = store.add_person(&name, role, &hash, SystemTime::now());
                added.map_err(failed)?;
                note(&store, "person.add", &name, ["", role.word()])?;
                print_line(&format!("{name} is {} now", role.word()))?;
            }
            What::Password { name, place } => {
                let store = place.store()?;
                let hash = ask_password(&name)?;
                let changed =
                    store.change_person(&name, None, Some(&hash), None, SystemTime::now());
                changed.map_err(failed)?;
                note(&store, "person.change", &name, ["", "new password"])?;
                print_line(&format!("{name} has a new password"))?;
            }
            What::List { place, json } => return list(&place.store()?, json),
            What::Disable { name, place } => enable(&place.store()?, &name, false)?,
            What::Enable { name, place } => enable(&place.store()?, &name, true)?,
        }
        Ok(Status::Done)
    }
}

impl Place {
    fn store(&self) -> Result<Store, Failure> {
        let cell = read_cell(&self.cell)?;
        Store::open(&cell.service.store).map_err(failed)
    }
}

fn list(store: &Store, json: bool) -> Result<Status, Failure> {
    let people = store.people().map_err(failed)?;
    if json {
        print_line(&serde_json::json!({ "people": people }).to_string())?;
        return Ok(Status::Done);
    }
    for person in &people {
        let enabled = if person.enabled { "" } else { "  disabled" };
        let (name, role) = (&person.name, person.role.word());
        print_line(&format!("{name:24} {role:14}{enabled}"))?;
    }
    if people.is_empty() {
        print_line(
            "nobody; add the first administrator with `acies person add NAME --role administrator`",
        )?;
    }
    Ok(Status::Done)
}

fn enable(store: &Store, name: &str, enabled: bool) -> Result<(), Failure> {
    let changed = store.change_person(name, None, None, Some(enabled), SystemTime::now());
    changed.map_err(failed)?;
    let word = |enabled| if enabled { "enabled" } else { "disabled" };
    note(
        store,
        "person.change",
        name,
        [word(!enabled), word(enabled)],
    )?;
    print_line(&format!("{name} is {} now", word(enabled)))
}

/// Who changes people from the command line may write the store's files: the system knows them, we do not.
fn note(store: &Store, action: &str, subject: &str, [old, new]: [&str; 2]) -> Result<(), Failure> {
    let entry = Audit {
        person: "command line",
        action,
        subject,
        old,
        new,
        why: "",
    };
    store.audit(&entry, SystemTime::now()).map_err(failed)
}

/// The hash of a password that is typed twice, or of the first line of standard input.
fn ask_password(name: &str) -> Result<String, Failure> {
    let password = if std::io::stdin().is_terminal() {
        let typed = |prompt: String| {
            rpassword::prompt_password(prompt)
                .context("the terminal")
                .map_err(Failure::Io)
        };
        let first = typed(format!("Password of {name}: "))?;
        if typed("The same again: ".to_owned())? != first {
            return Err(Failure::Usage(anyhow!(
                "the two passwords differ; type the same one twice"
            )));
        }
        first
    } else {
        let mut text = String::new();
        std::io::stdin()
            .take(PIPED_MAX)
            .read_to_string(&mut text)
            .context("standard input: expected the password as UTF-8")
            .map_err(Failure::Io)?;
        text.lines().next().unwrap_or_default().to_owned()
    };
    web::hash_password(&password).map_err(|error| Failure::Usage(error.into()))
}

fn failed(error: StoreError) -> Failure {
    match error {
        StoreError::Missing { .. } | StoreError::Exists { .. } => Failure::Usage(error.into()),
        _ => Failure::Io(error.into()),
    }
}

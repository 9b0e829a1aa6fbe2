//! The `acies` program: reads the command line, sets up logs, and turns a failure into words and an exit status.

use std::io::IsTerminal;
use std::process::ExitCode;

use acies::cli::{Command, Failure};
use clap::Parser;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// Threads come and go with every part, and glibc keeps what each took: with the page open the daemon grew to twice the memory
/// that it has with this allocator.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Finds the sharp edges of a scanned part and measures each against its nominal NURBS edge.
///
/// Exit status: 0 done (and OK, where there is a verdict), 1 not OK, 2 not decidable, 64 wrong usage, 65 bad input,
/// 70 our fault, 74 input or output failed.
#[derive(Debug, Parser)]
#[command(name = "acies", version, after_help = "Start with: acies demo")]
struct Arguments {
    #[command(subcommand)]
    command: Command,
    /// What to log on standard error: error, warn, info, debug, trace, or a filter such as acies=debug.
    #[arg(
        long,
        global = true,
        env = "ACIES_LOG",
        default_value = "warn",
        value_name = "LEVEL"
    )]
    log: String,
}

fn main() -> ExitCode {
    let arguments = match Arguments::try_parse() {
        Ok(arguments) => arguments,
        Err(error) => {
            // clap prints help to standard output and mistakes to standard error; only its exit status is not ours.
            let printed = error.print();
            return if error.use_stderr() || printed.is_err() {
                ExitCode::from(64)
            } else {
                ExitCode::SUCCESS
            };
        }
    };
    let Ok(filter) = arguments.log.parse::<Targets>() else {
        let log = &arguments.log;
        eprintln!("acies: --log {log:?} is no level; expected one such as info, or acies=debug");
        return ExitCode::from(64);
    };
    // Under systemd the journal takes the fields as they are; elsewhere people read lines.
    let under_systemd = std::env::var_os("JOURNAL_STREAM").is_some();
    let journal = under_systemd
        .then(tracing_journald::layer)
        .and_then(Result::ok);
    let lines = journal.is_none().then(|| {
        tracing_subscriber::fmt::layer()
            .with_writer(std::io::stderr)
            .with_ansi(std::io::stderr().is_terminal())
    });
    tracing_subscriber::registry()
        .with(filter)
        .with(journal)
        .with(lines)
        .init();
    match arguments.command.run() {
        Ok(status) => status.into(),
        Err(failure) => {
            report(&failure);
            ExitCode::from(failure.exit_status())
        }
    }
}

/// The failure with its causes, on standard error.
fn report(failure: &Failure) {
    let (Failure::Usage(error)
    | Failure::BadInput(error)
    | Failure::Internal(error)
    | Failure::Io(error)) = failure;
    let mut text = error.to_string();
    for cause in error.chain().skip(1).map(ToString::to_string) {
        // Some errors say their cause themselves; once is enough.
        if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    eprintln!("acies: {text}");
}

//! USB drivers against simulated devices, every case twice: with the device called in this process, and through libusb in a child process that
//! umockdev's preload library shows the device to. Where that library is not installed the second half says so and is passed by. `kernel.sh` runs
//! the same cases through a real kernel instead.

mod cases;
mod hesitant;
mod kernel;
mod rig;

use std::io::Write;
use std::panic::{AssertUnwindSafe, catch_unwind};

use cases::CASES;
use rig::{Child, InProcess, OverLibusb};

/// A line on standard output, unlike `println` also where the lints forbid that.
fn say(text: &str) {
    let _ = writeln!(std::io::stdout(), "{text}");
}

fn main() {
    if let Some((case, variant)) = rig::child_of_a_case() {
        let case = CASES
            .iter()
            .find(|known| known.name == case)
            .expect("a case of this name");
        (case.run)(&Child::new(), variant);
        return;
    }
    let filters: Vec<String> = std::env::args()
        .skip(1)
        .filter(|a| !a.starts_with('-'))
        .collect();
    if std::env::args().any(|argument| argument == "--list") {
        return;
    }
    let wanted =
        |name: &str| filters.is_empty() || filters.iter().any(|f| name.contains(f.as_str()));
    let library = acies_simulators::usb::preload::library();
    let (mut passed, mut failed, mut skipped) = (0, 0, 0);
    let mut machine = kernel::folder().map(|folder| kernel::Machine::boot(&folder));
    for case in CASES.iter().filter(|case| wanted(case.name)) {
        for (variant, device) in (case.devices)().into_iter().enumerate() {
            let mut told = |way: &str, ran: bool| {
                say(&format!(
                    "test {way}::{} ({variant}) ... {}",
                    case.name,
                    if ran { "ok" } else { "FAILED" }
                ));
                if ran { passed += 1 } else { failed += 1 }
            };
            if let Some(machine) = &mut machine {
                if (case.name, variant) == kernel::NOT_CARRIED {
                    skipped += 1;
                    continue;
                }
                told("in_kernel", machine.run(device, case.name, variant));
                continue;
            }
            let rig = InProcess::new(device.clone());
            let ran = catch_unwind(AssertUnwindSafe(|| (case.run)(&rig, variant)));
            told("in_process", ran.is_ok());
            match &library {
                Some(_) => told(
                    "over_libusb",
                    OverLibusb::new(device).run(case.name, variant),
                ),
                None => skipped += 1,
            }
        }
    }
    if skipped > 0 && machine.is_some() {
        say(&format!(
            "skipped: {:?}, which QEMU does not carry",
            kernel::NOT_CARRIED
        ));
    } else if skipped > 0 {
        say(&format!(
            "skipped: {skipped} cases over libusb, for want of {} (Debian package umockdev)",
            acies_simulators::usb::preload::LIBRARY
        ));
    }
    say(&format!(
        "test result: {passed} passed; {failed} failed; {skipped} skipped"
    ));
    // Before an exit that drops nothing.
    drop(machine);
    if failed > 0 {
        std::process::exit(101);
    }
}

//! The third way to a simulated device: a real kernel in QEMU, which sees it behind a host controller (`kernel.sh` beside this file).
//!
//! The virtual machine runs this same program as the child of each case; its console carries the orders. One machine runs all cases, and
//! each device is plugged in for its case.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use acies_simulators::u3v::Profiler;
use acies_simulators::usb::redir::Redirected;
use acies_simulators::usb_itn::InputTool;

use crate::rig::{Device, ORDER, Plug, SOON};

/// The folder with `vmlinuz` and `initrd`, where `kernel.sh` asks for this way.
pub fn folder() -> Option<PathBuf> {
    std::env::var_os("ACIES_USB_KERNEL").map(PathBuf::from)
}

/// A case and variant that QEMU does not carry: an interrupt transfer that waits is not woken for a stall, which then comes with the next one, and the
/// readings in between count as missing. Seen with QEMU 7.2; the cause was read off its behaviour, not its source.
pub const NOT_CARRIED: (&str, usize) = ("itn_losses_are_exact", 2);

enum AnyRedirected {
    U3v(Redirected<Profiler>),
    Itn(Redirected<InputTool>),
}

impl AnyRedirected {
    fn offer(&self) {
        match self {
            AnyRedirected::U3v(device) => device.offer(),
            AnyRedirected::Itn(device) => device.offer(),
        }
    }
}

/// A running machine.
pub struct Machine {
    qemu: Child,
    console: BufReader<ChildStdout>,
    input: ChildStdin,
    /// QEMU comes here for a device, every second where none is plugged in.
    listener: UnixListener,
}

impl Machine {
    /// Boots it and waits until it takes cases.
    pub fn boot(folder: &Path) -> Machine {
        let socket = folder.join("redir.sock");
        let _ = std::fs::remove_file(&socket);
        let listener = UnixListener::bind(&socket).expect("a socket");
        let mut qemu = Command::new("qemu-system-x86_64")
            .args(
                "-accel tcg,thread=multi -machine pc -cpu max -smp 1 -m 512 -nodefaults".split(' '),
            )
            .args("-no-user-config -no-reboot -display none -serial stdio".split(' '))
            .arg("-kernel")
            .arg(folder.join("vmlinuz"))
            .arg("-initrd")
            .arg(folder.join("initrd"))
            .args(["-append", "console=ttyS0 quiet loglevel=0 panic=-1"])
            .args(["-device", "qemu-xhci", "-device", "usb-redir,chardev=redir"])
            .arg("-chardev")
            .arg(format!(
                "socket,id=redir,reconnect=1,path={}",
                socket.display()
            ))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("qemu-system-x86_64");
        let input = qemu.stdin.take().expect("its input");
        let console = BufReader::new(qemu.stdout.take().expect("its console"));
        let mut machine = Machine {
            qemu,
            console,
            input,
            listener,
        };
        while machine.line() != "READY" {}
        machine
    }

    fn line(&mut self) -> String {
        let mut bytes = Vec::new();
        let n = self
            .console
            .read_until(b'\n', &mut bytes)
            .expect("a console");
        assert!(n > 0, "the machine is gone");
        String::from_utf8_lossy(&bytes).trim().to_owned()
    }

    /// Plugs the device in, and waits until the kernel has set it up.
    fn plug(&self, plug: &Plug) -> AnyRedirected {
        let (stream, _) = self.listener.accept().expect("the machine");
        match plug {
            Plug::U3v(socket) => {
                let device = Redirected::start(stream, socket.clone())
                    .expect("a machine that speaks usbredir");
                assert!(
                    device.wait_until_configured(SOON),
                    "the kernel does not take it"
                );
                AnyRedirected::U3v(device)
            }
            Plug::Itn(socket) => {
                let device = Redirected::start(stream, socket.clone())
                    .expect("a machine that speaks usbredir");
                assert!(
                    device.wait_until_configured(SOON),
                    "the kernel does not take it"
                );
                AnyRedirected::Itn(device)
            }
        }
    }

    /// Runs a case in the machine and serves its orders; true where it passed.
    pub fn run(&mut self, device: Device, case: &str, variant: usize) -> bool {
        let plug = Plug::new(device);
        let mut plugged = Some(self.plug(&plug));
        writeln!(self.input, "{case} {variant}").expect("the console");
        loop {
            let line = self.line();
            if let Some(status) = line.strip_prefix("DONE ") {
                return status == "0";
            }
            let Some(order) = line.strip_prefix(ORDER) else {
                crate::say(&line);
                continue;
            };
            let answer = match order {
                "unplug" => {
                    plug.unplug();
                    plugged = None;
                    String::new()
                }
                "replug" => {
                    plug.replug();
                    plugged = Some(self.plug(&plug));
                    String::new()
                }
                // The kernel's own limit stays.
                order if order.starts_with("memory") => "no system".into(),
                order => plug.carry_out(order, || plugged.iter().for_each(AnyRedirected::offer)),
            };
            assert!(
                plugged.is_some() || order == "unplug" || order == "another" || order == "truth"
            );
            writeln!(self.input, "{answer}").expect("the console");
        }
    }
}

impl Drop for Machine {
    fn drop(&mut self) {
        let _ = self.qemu.kill();
        let _ = self.qemu.wait();
    }
}

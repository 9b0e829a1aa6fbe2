//! The Gocator driver against its simulated sensor.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use acies_drivers::capture::Profile;
use acies_drivers::device::{Instrument, Presence, Profiler};
use acies_drivers::error::DeviceError;
use acies_drivers::link::Links;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::recording::{Recorder, Recording};
use acies_drivers::link::replay::{Match, Replay};
use acies_simulators::demo_cell::DemoCell;
use acies_simulators::gocator::{Form, Misdeeds, Setup, SimulatedGocator, Surface};

use crate::support::{Hostile, SOON, open, refusal, setup, text};

const SERIAL: u32 = 13_434;

fn start(setup: Setup) -> (SimulatedGocator, Box<dyn Profiler>) {
    let device = SimulatedGocator::start(setup).expect("a simulated sensor");
    let table = format!(
        "{}\nserial_number = {SERIAL}\nfirst_frame = 0\nkeepalive_s = 0.2",
        device.keys()
    );
    match open("gocator", &table) {
        Ok(Instrument::Profiler(profiler)) => (device, profiler),
        Ok(_) => panic!("no profiler"),
        Err(error) => panic!("{}", text(&error)),
    }
}

fn wave(misdeeds: Misdeeds) -> Setup {
    Setup {
        misdeeds,
        ..Setup::new(SERIAL, Surface::Wave(320))
    }
}

fn scan(profiler: &mut dyn Profiler, n: usize) -> Result<Vec<Profile>, DeviceError> {
    profiler.start()?;
    let mut profiles = Vec::new();
    while profiles.len() < n {
        let profile = profiler.next(Instant::now() + SOON)?;
        profiles.push(profile.expect("a profile in time"));
    }
    profiles.extend(profiler.stop()?);
    Ok(profiles)
}

/// Whether a point lies between two neighbours of a line, to 5 um: rounding of both coordinates on a steep side.
fn lies_on(x_mm: &[f64], z_mm: &[f64], x: f64, z: f64) -> bool {
    x_mm.windows(2).zip(z_mm.windows(2)).any(|(xs, zs)| {
        let inside = |v: f64, pair: &[f64]| {
            v >= pair[0].min(pair[1]) - 0.005 && v <= pair[0].max(pair[1]) + 0.005
        };
        inside(x, xs) && inside(z, zs)
    })
}

#[test]
fn each_form_of_profile_shows_the_same_surface() {
    let view = DemoCell::new(5).sensors[0].view.clone();
    let mut on_surface = 0;
    for form in [Form::Uniform, Form::PointCloud] {
        for attribute_size in [32, 40] {
            let (device, mut profiler) = start(Setup {
                form,
                attribute_size,
                intensity: true,
                frames: 40,
                ..Setup::new(SERIAL, Surface::View(Box::new(view.clone())))
            });
            assert_eq!(profiler.identity().serial, SERIAL.to_string());
            assert_eq!(profiler.identity().firmware, "5.2.18.3");
            let profiles = scan(profiler.as_mut(), 40).expect("a scan");
            assert_eq!(profiles.len(), 40);
            assert!(!device.status().laser_on);
            for (index, profile) in profiles.iter().enumerate() {
                let truth = view.line(index as u32);
                assert_eq!(profile.encoder, Some(truth.encoder));
                assert_eq!(profile.x_mm.len(), truth.x_mm.len());
                assert_eq!(profile.intensity.len(), truth.x_mm.len());
                assert!(profile.x_mm.iter().all(|x| x.is_finite()));
                if form == Form::PointCloud {
                    for (found, true_z) in profile.z_mm.iter().zip(&truth.z_mm) {
                        assert_eq!(found.is_nan(), true_z.is_nan());
                        // Half a count of 3 um, and half a micrometre of the offset.
                        assert!(
                            found.is_nan() || (found - true_z).abs() <= 0.002_001,
                            "{found} {true_z}"
                        );
                    }
                } else {
                    let seen = profile.x_mm.iter().zip(&profile.z_mm);
                    for (x, z) in seen.filter(|(_, z)| !z.is_nan()) {
                        assert!(lies_on(&truth.x_mm, &truth.z_mm, *x, *z), "{x} {z}");
                        on_surface += 1;
                    }
                }
            }
        }
    }
    assert!(
        on_surface > 1_000,
        "{on_surface} points of uniform profiles"
    );
}

/// Scans with a fault and holds every count to the sensor's own log.
fn losses_are_exact(setup: Setup, n: usize) {
    let (device, mut profiler) = start(setup);
    let profiles = scan(profiler.as_mut(), n).expect("a scan");
    let (losses, status) = (profiler.losses(), device.status());
    let received: Vec<u64> = profiles.iter().map(|p| p.sequence.into()).collect();
    let sent: BTreeSet<u64> = status.sent.iter().copied().collect();
    assert!(received.is_sorted_by(|a, b| a < b), "in order, none twice");
    assert_eq!(received.iter().copied().collect::<BTreeSet<_>>(), sent);
    assert_eq!(losses.received, received.len() as u64);
    let last = received.last().copied().expect("a profile");
    // A frame that is lost behind the last one has no successor that tells.
    assert_eq!(losses.received + losses.lost_on_link, last + 1);
}

#[test]
fn losses_are_exact_whatever_is_lost_lied_about_or_doubled() {
    losses_are_exact(wave(Misdeeds::default()), 2_000);
    losses_are_exact(
        wave(Misdeeds {
            drop: 0.1,
            ..Misdeeds::default()
        }),
        1_000,
    );
    losses_are_exact(
        wave(Misdeeds {
            lie: 0.1,
            ..Misdeeds::default()
        }),
        1_000,
    );
    losses_are_exact(
        wave(Misdeeds {
            drop: 0.05,
            lie: 0.05,
            duplicate: 0.1,
            pieces: Some(211),
            ..Misdeeds::default()
        }),
        500,
    );
    let batched = Setup {
        batch: 7,
        ..wave(Misdeeds {
            drop: 0.1,
            ..Misdeeds::default()
        })
    };
    losses_are_exact(batched, 1_000);
}

#[test]
fn dropped_triggers_are_counted_by_the_health_channel() {
    let (device, mut profiler) = start(Setup {
        frames: 100,
        ..wave(Misdeeds {
            trigger_drops: 3,
            ..Misdeeds::default()
        })
    });
    profiler.start().expect("a start");
    let mut received = 0;
    let deadline = Instant::now() + SOON;
    while profiler.losses().dropped_by_device < 300 {
        assert!(Instant::now() < deadline, "{:?}", profiler.losses());
        received += usize::from(profiler.next(Instant::now()).expect("a link").is_some());
    }
    received += profiler.stop().expect("a stop").len();
    assert_eq!(received, 100);
    assert_eq!(
        profiler.losses().dropped_by_device,
        device.status().trigger_drops
    );
}

#[test]
fn a_second_run_counts_from_zero_again() {
    let (_device, mut profiler) = start(wave(Misdeeds::default()));
    for _ in 0..2 {
        let profiles = scan(profiler.as_mut(), 50).expect("a scan");
        assert_eq!(profiles[0].sequence, 0);
        assert_eq!(profiler.losses().lost_on_link, 0);
    }
}

#[test]
fn a_slow_caller_loses_nothing_and_the_queue_is_bounded() {
    let (device, mut profiler) = start(Setup {
        rate_hz: None,
        ..wave(Misdeeds::default())
    });
    profiler.start().expect("a start");
    // The pings prove that time passes while nobody takes a profile.
    let pings = device.status().pings;
    assert!(device.wait_until(SOON, |status| status.pings >= pings + 5));
    let taken = device.status().taken;
    // 64 MiB of queue hold 320 points of 16 bytes 13,000 times; sockets and one read a few thousand more.
    assert!(taken < 60_000, "{taken} frames were taken in");
    let rest = profiler.stop().expect("a stop");
    assert_eq!(profiler.losses().lost_on_link, 0);
    assert_eq!(rest.len() as u64, device.status().sent_count);
}

/// What ends a scan.
fn end_of_scan(misdeeds: Misdeeds) -> String {
    let (_device, mut profiler) = start(wave(misdeeds));
    let error = scan(profiler.as_mut(), 100_000).expect_err("an end");
    text(&error)
}

#[test]
fn whatever_ends_a_scan_is_told() {
    let cut = end_of_scan(Misdeeds {
        cut_at: Some(50),
        ..Misdeeds::default()
    });
    assert!(
        cut.ends_with("it is gone: closed or unplugged; plug it in again and reopen"),
        "{cut}"
    );
    let size = end_of_scan(Misdeeds {
        bad_size_at: Some(50),
        ..Misdeeds::default()
    });
    assert!(
        size.ends_with(
            "bad data from the device: frame says 4294967295 bytes, at most 8388608 are allowed"
        ),
        "{size}"
    );
    let clock = end_of_scan(Misdeeds {
        clock_back_at: Some(50),
        ..Misdeeds::default()
    });
    assert!(
        clock.ends_with("the device ended the run: its clock went back: it started anew; check its supply, then reopen it"),
        "{clock}"
    );
    let silent = end_of_scan(Misdeeds {
        silent_at: Some(50),
        ..Misdeeds::default()
    });
    assert!(
        silent.ends_with("no answer within 3 s; check power and cable, then retry"),
        "{silent}"
    );
}

#[test]
fn refusals_are_told() {
    let device = SimulatedGocator::start(wave(Misdeeds {
        refuse_start: Some(-1000),
        ..Misdeeds::default()
    }));
    let device = device.expect("a simulated sensor");
    let Ok(Instrument::Profiler(mut profiler)) = open("gocator", &device.keys()) else {
        panic!("it does not open");
    };
    let address = device.address();
    assert_eq!(
        text(&profiler.start().expect_err("a refusal")),
        format!(
            "{address}: Start is refused: the state of the sensor forbids it (-1000); stop it from its web page, close other clients, check the laser's interlock, then retry"
        )
    );
    assert_eq!(
        refusal("gocator", &format!("{}\nserial_number = 1", device.keys())),
        format!(
            "{address}: answers as \"13434\", the configuration expects \"1\"; check which device is plugged in where"
        )
    );
}

#[test]
fn wrong_peers_are_told_apart() {
    let told = |setup: Setup| {
        let device = SimulatedGocator::start(setup).expect("a simulated sensor");
        let text = refusal("gocator", &device.keys());
        let (_, text) = text.split_once(": ").expect("an address");
        text.to_owned()
    };
    assert_eq!(
        told(wave(Misdeeds {
            mute: true,
            ..Misdeeds::default()
        })),
        "no answer within 3 s; check power and cable, then retry"
    );
    assert_eq!(
        told(wave(Misdeeds {
            babble: true,
            ..Misdeeds::default()
        })),
        "bad data from the device: frame says 1347703880 bytes, at most 1048576 are allowed"
    );
    assert_eq!(
        told(Setup {
            version: 2,
            ..wave(Misdeeds::default())
        }),
        "bad data from the device: protocol version 2, this program knows 1; update the one that is older"
    );
    let closing = Hostile::new(Vec::new(), false);
    let text = refusal("gocator", &format!("address = '{}'", closing.address));
    assert!(
        text.ends_with("it is gone: closed or unplugged; plug it in again and reopen"),
        "{text}"
    );
    // Half a reply, and silence: a peer that hangs.
    let half = Hostile::new(vec![12, 0, 0, 0, 0x11], true);
    let text = refusal("gocator", &format!("address = '{}'", half.address));
    assert!(
        text.ends_with("5 bytes came within 3 s, but no answer to Get Protocol Version; check `driver` and `baud`"),
        "{text}"
    );
}

#[test]
fn the_laser_is_off_after_drop_and_for_a_host_that_died() {
    let (device, mut profiler) = start(wave(Misdeeds::default()));
    profiler.start().expect("a start");
    assert!(device.status().laser_on);
    drop(profiler);
    assert!(!device.status().laser_on);
    // A host before us left it running: opening stops it.
    let (device, mut profiler) = start(wave(Misdeeds::default()));
    profiler.start().expect("a start");
    std::mem::forget(profiler);
    let again = open("gocator", &device.keys());
    assert!(again.is_ok() && !device.status().laser_on);
}

/// An encoder that trembles is delivered as it reads: what a reversal means is the assembly's to say (`acquire::assembler`).
#[test]
fn an_encoder_that_shakes_is_delivered_as_it_reads() {
    let (_device, mut profiler) = start(Setup {
        frames: 200,
        ..wave(Misdeeds {
            encoder_jitter: 15,
            ..Misdeeds::default()
        })
    });
    let profiles = scan(profiler.as_mut(), 200).expect("a scan");
    let beside: Vec<i64> = (0..)
        .zip(&profiles)
        .map(|(index, profile)| profile.encoder.expect("an encoder") - 10 * index)
        .collect();
    assert!(beside.iter().all(|counts| counts.abs() <= 15));
    let distinct: BTreeSet<&i64> = beside.iter().collect();
    assert_eq!(distinct.len(), 31, "each number of the range is met");
    let back = profiles
        .windows(2)
        .filter(|two| two[1].encoder < two[0].encoder);
    assert!(back.count() > 20, "some of them against the motion");
}

#[test]
fn replies_that_are_late_turned_or_unasked_are_told_apart() {
    let late = |ms| Misdeeds {
        late: Some(Duration::from_millis(ms)),
        ..Misdeeds::default()
    };
    let stray = |stray_replies| Misdeeds {
        stray_replies,
        ..Misdeeds::default()
    };
    // What is not asked for is passed over, and a slow sensor waited for.
    for misdeeds in [late(300), stray(5)] {
        let (_device, mut profiler) = start(wave(misdeeds));
        assert!(scan(profiler.as_mut(), 20).expect("a scan").len() >= 20);
        assert_eq!(profiler.losses().lost_on_link, 0);
    }
    let told = |misdeeds| {
        let device = SimulatedGocator::start(wave(misdeeds)).expect("a simulated sensor");
        let text = refusal("gocator", &device.keys());
        text.split_once(": ").expect("an address").1.to_owned()
    };
    let silent = "no answer within 3 s; check power and cable, then retry";
    assert_eq!(told(late(3500)), silent);
    assert_eq!(
        told(stray(20)),
        "bad data from the device: Get Protocol Version was answered by a message of another kind"
    );
    let turned = told(Misdeeds {
        swap_bytes: true,
        ..Misdeeds::default()
    });
    // 12 bytes, with the great end first.
    assert_eq!(
        turned,
        "bad data from the device: frame says 201326592 bytes, at most 1048576 are allowed"
    );
}

#[test]
fn an_idle_sensor_is_asked_and_a_silent_one_told() {
    let (device, mut profiler) = start(wave(Misdeeds {
        silent_at: Some(50),
        ..Misdeeds::default()
    }));
    assert_eq!(profiler.check().ok(), Some(Presence::Answered));
    assert!(!device.status().laser_on);
    scan(profiler.as_mut(), 10_000).expect_err("it falls silent");
    let error = profiler.check().expect_err("a silent sensor");
    assert!(error.may_pass(), "{}", text(&error));
}

#[test]
fn every_mistake_of_a_table_is_told() {
    let mistakes =
        setup("gocator", "address = 'a:b:c'\nsource = 'left'\nport = 1").expect_err("mistakes");
    let told: Vec<String> = mistakes.iter().map(ToString::to_string).collect();
    assert_eq!(
        told,
        [
            "address: \"a:b:c\", expected a host, or host:port, as in \"192.168.1.10\"",
            "source: \"left\", expected \"top\" or \"bottom\" or \"top-left\" or \"top-right\"",
            "port: an unknown key, expected one of address, data_port, health_port, serial_number, source, first_frame, flip_z, drops_indicator, protocol_version, keepalive_s",
        ]
    );
}

#[test]
fn a_recording_of_all_three_channels_plays_back_the_same() {
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("gocator-recorded");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("a folder");
    let device = SimulatedGocator::start(Setup {
        frames: 500,
        ..wave(Misdeeds {
            drop: 0.02,
            lie: 0.02,
            trigger_drops: 2,
            ..Misdeeds::default()
        })
    });
    let device = device.expect("a simulated sensor");
    let table = format!("{}\nfirst_frame = 0\nkeepalive_s = 0.2", device.keys());
    let taken = |links: &dyn Links, table: &str| {
        let setup = setup("gocator", table).expect("a table");
        let mut profiler = match setup.open(links) {
            Ok(Instrument::Profiler(profiler)) => profiler,
            Ok(_) => panic!("no profiler"),
            Err(error) => panic!("{}", text(&error)),
        };
        profiler.start().expect("a start");
        let mut profiles = Vec::new();
        // The last frames may be among those that are lost.
        while profiles.last().is_none_or(|p: &Profile| p.sequence < 480) {
            let profile = profiler.next(Instant::now() + SOON);
            let profile = profile.unwrap_or_else(|error| panic!("{}", text(&error)));
            profiles.push(profile.expect("a profile in time"));
        }
        // Dropped triggers come by health, ten times a second; a replay gives them as they were.
        let until = Instant::now() + SOON;
        while profiler.losses().dropped_by_device < 1000 && Instant::now() < until {
            profiles.extend(profiler.next(Instant::now()).expect("a link"));
        }
        profiles.extend(profiler.stop().expect("a stop"));
        let identity = profiler.identity().clone();
        let losses = profiler.losses();
        let kept = profiles
            .into_iter()
            .map(|p| (p.sequence, p.device_time_ns, p.encoder, p.x_mm));
        (identity, losses, kept.collect::<Vec<_>>())
    };
    let recorder = Recorder::of_device(Cable, &folder, 1 << 28, vec!["a note".into()]);
    let live = taken(&recorder, &table);
    assert!(
        live.1.lost_on_link > 0 && live.1.dropped_by_device == 1000,
        "{:?}",
        live.1
    );
    let mut files = std::fs::read_dir(&folder).expect("the folder");
    let file = files.next().expect("a recording").expect("an entry").path();
    assert!(files.next().is_none(), "one file for all channels");
    let recording = Recording::read(&file).expect("a recording");
    let channels: BTreeSet<u8> = recording
        .records
        .iter()
        .map(|record| record.channel)
        .collect();
    assert_eq!(channels, BTreeSet::from([0, 1, 2]));
    // The device has moved to another address since.
    let moved = "address = \"10.1.2.3\"\nfirst_frame = 0\nkeepalive_s = 0.2";
    for table in [table.as_str(), moved] {
        let links = Replay::new(recording.clone(), Match::Loose(Duration::from_millis(20)));
        let replayed = taken(&links, table);
        assert_eq!(live, replayed);
    }
}

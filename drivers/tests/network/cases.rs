//! Which of the 25 fault cases applies to which driver of a network or USB device, and which test holds it. The serial ones all go through
//! one suite (`tests/drivers`).

use acies_drivers::ALL;
use acies_simulators::faults::CASES;

use Entry::{Cannot, Held};

/// What stands behind a case.
enum Entry {
    /// The test of this name.
    Held(&'static str),
    /// It cannot happen, and why.
    Cannot(&'static str),
}

const TCP: Entry = Cannot("TCP loses, changes and reorders no bytes");
const CRC: Entry = Cannot("USB checks every packet and repeats it");
const NOT_SERIAL: Entry = Cannot("no serial line");
const NOT_USB: Entry = Cannot("no USB");
const NO_ENCODER: Entry = Cannot("it sends no encoder");
const NO_CLOCK: Entry = Cannot("it sends no time");

/// In the order of [`CASES`].
const TABLE: [(&str, [Entry; 25]); 5] = [
    (
        "gocator",
        [
            TCP,
            TCP,
            Held("losses_are_exact_whatever_is_lost_lied_about_or_doubled"),
            Cannot("commands and data have connections of their own"),
            NOT_SERIAL,
            Held("each_form_of_profile_shows_the_same_surface"),
            Cannot("index and time have 64 bits"),
            Cannot("the encoder has 64 bits"),
            Held("an_encoder_that_shakes_is_delivered_as_it_reads"),
            Held("dropped_triggers_are_counted_by_the_health_channel"),
            Held("losses_are_exact_whatever_is_lost_lied_about_or_doubled"),
            Held("whatever_ends_a_scan_is_told"),
            Held("losses_are_exact_whatever_is_lost_lied_about_or_doubled"),
            Held("replies_that_are_late_turned_or_unasked_are_told_apart"),
            NOT_USB,
            Held("replies_that_are_late_turned_or_unasked_are_told_apart"),
            Held("whatever_ends_a_scan_is_told"),
            Held("refusals_are_told"),
            Held("the_laser_is_off_after_drop_and_for_a_host_that_died"),
            Held("dropped_triggers_are_counted_by_the_health_channel"),
            Held("a_slow_caller_loses_nothing_and_the_queue_is_bounded"),
            Held("refusals_are_told"),
            Held("replies_that_are_late_turned_or_unasked_are_told_apart"),
            Held("whatever_ends_a_scan_is_told"),
            Held("whatever_ends_a_scan_is_told"),
        ],
    ),
    (
        "ippdme",
        [
            TCP,
            TCP,
            Held("every_touch_is_where_the_tip_was_however_the_server_reports_it"),
            Held("every_touch_is_where_the_tip_was_however_the_server_reports_it"),
            NOT_SERIAL,
            Cannot("a point is a number or an error"),
            Cannot("tags are the client's own"),
            NO_ENCODER,
            NO_ENCODER,
            Cannot("it is asked for every point"),
            TCP,
            Held("what_ends_a_touch_is_told"),
            Cannot("lines end with their end"),
            Cannot("numbers are text"),
            NOT_USB,
            Held("a_late_server_is_waited_for_and_an_idle_one_asked"),
            Held("what_ends_a_touch_is_told"),
            Held("wrong_peers_are_told_apart"),
            Held("a_second_client_waits_and_a_session_ends_with_its_driver"),
            Cannot("it is asked for every point"),
            Cannot("it is asked for every point"),
            Held("after_other_errors_nothing_moves_until_it_is_reopened"),
            Held("every_touch_is_where_the_tip_was_however_the_server_reports_it"),
            NO_CLOCK,
            Held("what_ends_a_touch_is_told"),
        ],
    ),
    (
        "ur-rtde",
        [
            TCP,
            TCP,
            Held("refusals_are_told"),
            Held("skipped_damaged_and_doubled_packages_are_counted"),
            NOT_SERIAL,
            Held("skipped_damaged_and_doubled_packages_are_counted"),
            Cannot("time is a number of 64 bits"),
            NO_ENCODER,
            NO_ENCODER,
            Held("skipped_damaged_and_doubled_packages_are_counted"),
            Held("skipped_damaged_and_doubled_packages_are_counted"),
            Held("skipped_damaged_and_doubled_packages_are_counted"),
            Held("each_end_of_a_run_has_its_own_error"),
            Held("each_end_of_a_run_has_its_own_error"),
            NOT_USB,
            Held("refusals_are_told"),
            Held("each_end_of_a_run_has_its_own_error"),
            Held("refusals_are_told"),
            Held("refusals_are_told"),
            Held("skipped_damaged_and_doubled_packages_are_counted"),
            Held("the_queue_is_bounded_and_a_run_left_alone_is_stopped"),
            Held("refusals_are_told"),
            Held("skipped_damaged_and_doubled_packages_are_counted"),
            Held("drift_is_found_under_delays_that_only_ever_add"),
            Held("each_end_of_a_run_has_its_own_error"),
        ],
    ),
    (
        "u3v-profiler",
        [
            CRC,
            CRC,
            Cannot("no converter"),
            Cannot("commands and data have endpoints of their own"),
            NOT_SERIAL,
            Held("every_line_is_the_scene"),
            Cannot("block numbers have 64 bits"),
            Held("counters_and_clocks_come_whole"),
            Held("counters_and_clocks_come_whole"),
            Held("losses_are_exact"),
            Cannot("bulk transfers come in order and once"),
            Held("losses_are_exact"),
            Held("every_line_is_the_scene"),
            Held("every_line_is_the_scene"),
            Held("a_stall_costs_no_block"),
            Held("slow_control_is_waited_for"),
            Held("unplugged_in_a_scan_and_back"),
            Held("other_devices_are_refused"),
            Held("the_laser_goes_off"),
            Held("losses_are_exact"),
            Held("a_system_short_of_memory_gets_fewer_transfers"),
            Held("features_that_cannot_be_set"),
            Held("slow_control_is_waited_for"),
            Held("counters_and_clocks_come_whole"),
            Held("what_is_wrong_is_told"),
        ],
    ),
    (
        "usb-itn",
        [
            CRC,
            CRC,
            Cannot("no converter"),
            Cannot("it is asked for every reading"),
            NOT_SERIAL,
            Held("itn_losses_are_exact"),
            Cannot("readings have no numbers"),
            NO_ENCODER,
            NO_ENCODER,
            Cannot("it is asked for every reading"),
            Cannot("it is asked for every reading"),
            Held("itn_losses_are_exact"),
            Cannot("a reading has no length"),
            Cannot("numbers are text"),
            Held("itn_losses_are_exact"),
            Held("itn_losses_are_exact"),
            Held("itn_refusal_and_unplugging"),
            Held("itn_another_tool_is_not_taken_for_it"),
            Cannot("it streams nothing"),
            Cannot("it marks nothing as overrun"),
            Cannot("transfers of 64 bytes"),
            Held("itn_refusal_and_unplugging"),
            Held("itn_reads_a_gauge"),
            NO_CLOCK,
            Held("itn_silence_is_told"),
        ],
    ),
];

#[test]
fn every_case_of_every_driver_is_held_or_cannot_happen() {
    let tests = concat!(
        include_str!("gocator.rs"),
        include_str!("ippdme.rs"),
        include_str!("ur_rtde.rs"),
        include_str!("../usb/cases.rs"),
        // What drivers share, and what the program makes of a device's time.
        include_str!("../../src/link/pump.rs"),
        include_str!("../../../src/acquire/clock.rs")
    );
    let serial = [
        "open-profile",
        "grbl-probe",
        "optoncdt",
        "rf60x",
        "serial-gauge",
    ];
    for driver in ALL.iter().filter(|driver| !serial.contains(&driver.name)) {
        let listed = TABLE
            .iter()
            .filter(|(name, _)| *name == driver.name)
            .count();
        assert_eq!(listed, 1, "{} in the table of cases", driver.name);
    }
    for (driver, entries) in &TABLE {
        for (case, entry) in CASES.iter().zip(entries) {
            match entry {
                Held(test) => assert!(
                    tests.contains(&format!("fn {test}(")),
                    "{driver}, {}: there is no test {test}",
                    case.name
                ),
                Cannot(why) => assert!(!why.is_empty(), "{driver}, {}", case.name),
            }
        }
    }
}

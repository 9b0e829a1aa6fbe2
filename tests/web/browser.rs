//! The page in a real browser, against the real daemon with simulated devices.
//!
//! Where no Chromium is installed these tests say so and are passed by. `ACIES_SCREENSHOTS=FOLDER` writes a picture of every page.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use acies::store::Role;
use acies::web;
use acies::words::Language;
use headless_chrome::protocol::cdp::{Emulation, Page};
use headless_chrome::{Browser, LaunchOptions, Tab};

use super::bench::{LONG, Served};

/// A browser, or nothing where none is installed.
fn browser() -> Option<Browser> {
    let Ok(path) = headless_chrome::browser::default_executable() else {
        eprintln!("no Chromium here: the page is not tested in a browser");
        return None;
    };
    let options = LaunchOptions::default_builder()
        .path(Some(path))
        // A container's root may not build the sandbox; the page is our own.
        .sandbox(false)
        .window_size(Some((1440, 900)))
        .idle_browser_timeout(LONG)
        .args(vec![
            std::ffi::OsStr::new("--lang=en"),
            std::ffi::OsStr::new("--disable-gpu"),
        ])
        .build()
        .expect("options");
    Some(Browser::new(options).expect("the browser starts"))
}

/// A script that waits in the page until `condition` holds, and then gives "yes"; after 280 s it gives what the page shows.
pub fn waiting(condition: &str) -> String {
    format!(
        "new Promise((done) => {{ const end = performance.now() + 280000;
           const look = () => {{ let is = false; try {{ is = Boolean({condition}); }} catch {{ is = false; }}
             if (is) done('yes'); else if (performance.now() > end) done(document.body.innerText); else setTimeout(look, 40); }};
           look(); }})"
    )
}

/// One page in a browser.
struct Seen {
    tab: Arc<Tab>,
    root: String,
}

impl Seen {
    fn open(browser: &Browser, cell: &Served) -> Self {
        let tab = browser.new_tab().expect("a tab");
        tab.set_default_timeout(Duration::from_secs(290));
        let root = format!("http://{}/", cell.address);
        tab.navigate_to(&root).expect("an address");
        let seen = Self { tab, root };
        seen.until(
            "document.readyState === 'complete' && document.querySelector('#serial') !== null",
        );
        seen
    }

    /// Waits in the page until `condition` holds.
    fn until(&self, condition: &str) {
        let script = waiting(condition);
        let found = self.tab.evaluate(&script, true).expect("the page answers");
        let found = found.value.expect("a text");
        assert_eq!(found.as_str(), Some("yes"), "waited for: {condition}");
    }

    fn value(&self, expression: &str) -> String {
        let found = self.tab.evaluate(&format!("String({expression})"), false);
        let found = found.expect("the page answers").value.expect("a text");
        found.as_str().expect("a text").to_owned()
    }

    fn go(&self, place: &str) {
        self.value(&format!("location.hash = '#/{place}'"));
    }

    fn click(&self, selector: &str) {
        self.until(&format!(
            "document.querySelector('{selector}') && !document.querySelector('{selector}').disabled"
        ));
        self.value(&format!("document.querySelector('{selector}').click()"));
    }

    fn typed(&self, text: &str) {
        self.tab.type_str(text).expect("keys");
    }

    fn key(&self, key: &str) {
        self.tab.press_key(key).expect("a key");
    }

    fn login(&self, name: &str) {
        self.click("#person");
        self.until("document.activeElement.name === 'name'");
        self.typed(name);
        self.key("Tab");
        self.typed("a long sentence");
        self.key("Enter");
        self.until(&format!(
            "document.querySelector('#person').textContent === '{name}'"
        ));
    }

    /// Types a part's serial and Enter, as a barcode scanner does, and waits for its verdict.
    fn measured(&self, serial: &str) {
        // On a machine that is far too busy a simulated device may answer too late, and is then rightly taken for lost.
        for _ in 0..3 {
            self.until("!document.querySelector('#start').disabled");
            self.value("document.querySelector('#serial').focus()");
            self.typed(serial);
            self.key("Enter");
            let word = "document.querySelector('#verdict').textContent";
            self.until("document.querySelector('#serial').value === ''");
            self.until(&format!(
                "document.querySelector('#verdict-part').textContent === '{serial}' && ['NOT OK', 'Aborted'].includes({word})"
            ));
            if self.value(word) == "NOT OK" {
                return;
            }
        }
        panic!("three times a device was lost");
    }

    fn places(&self) -> String {
        self.value("[...document.querySelectorAll('#nav a')].map((a) => a.hash.slice(2)).join(' ')")
    }
}

fn people(cell: &Served) {
    let hash = web::hash_password("a long sentence").expect("a good password");
    for role in Role::ALL {
        let added = cell
            .store
            .add_person(role.word(), role, &hash, SystemTime::now());
        added.expect("somebody new");
    }
}

#[test]
fn a_part_is_started_by_keyboard_watched_judged_and_found_again_also_after_a_restart() {
    let Some(browser) = browser() else { return };
    let mut cell = Served::with_devices("browser");
    people(&cell);
    let page = Seen::open(&browser, &cell);
    page.until("!document.querySelector('#start').disabled");
    assert_eq!(
        page.value("document.activeElement.id"),
        "serial",
        "a barcode scanner types here"
    );

    // What comes and goes faster than a test can look is written down in the page.
    page.value(
        "(() => { window.seen = []; window.most = 0;
           new MutationObserver(() => { const word = document.querySelector('#verdict').textContent;
             if (seen.at(-1) !== word) seen.push(word);
             const points = Number((document.querySelector('#live-points').textContent.match(/[0-9,.]+/) ?? ['0'])[0].replace(/[,.]/g, ''));
             most = Math.max(most, points); }).observe(document.body, { subtree: true, childList: true, characterData: true }); return 1; })()",
    );
    page.typed("SN-42");
    page.key("Enter");
    page.until("document.querySelector('#verdict').textContent === 'NOT OK'");
    assert_eq!(
        page.value("document.querySelector('#verdict-part').textContent"),
        "SN-42"
    );
    let last = cell.handle().snapshot().last.clone().expect("a result");
    let because = last.because.expect("a reason in parts");
    let edge = because.edge.expect("an edge");
    let reason = page.value("document.querySelector('#reason').textContent");
    assert!(
        reason.starts_with(&edge) && reason.contains("outside its limits"),
        "{reason}"
    );
    let seen = page.value("seen.join(', ')");
    assert!(
        seen.contains("Scanning") && seen.contains("Computing"),
        "{seen}"
    );
    page.until("most > 1000");
    page.until("document.querySelectorAll('#result li').length > 0");
    // Edges were measured while the scan ran; in the end the result takes their place.
    let measured = cell.get("/api/v1/live/edges").json();
    assert!(measured["number"].as_u64() >= Some(1), "{measured}");
    page.until("document.querySelector('#live-edges').hidden");
    let worst = page.value("document.querySelector('#result li .badge').dataset.verdict");
    assert_eq!(worst, "not_ok", "the worst stands first");
    assert_eq!(
        page.value("document.querySelector('#serial').value"),
        "",
        "ready for the next code"
    );
    // Letters that are read from three metres: 1/200 of the distance is 15 mm, 57 pixels of 1/96 inch.
    let size: f64 = page
        .value("parseFloat(getComputedStyle(document.querySelector('#verdict')).fontSize)")
        .parse()
        .expect("a size");
    assert!(size * 0.7 > 57.0, "capitals of {size} px");

    page.go("history");
    page.until("document.querySelectorAll('#list tbody tr').length === 1");
    page.click("#list tbody a");
    page.until("document.querySelector('#report') && document.querySelector('#report').contentDocument.querySelector('h1, header')");
    page.until("document.querySelectorAll('tbody tr').length > 5");
    let small = page.value(
        "[...document.querySelectorAll('button, .button, nav a, input:not([type=checkbox]):not([hidden]), select')].filter((one) => one.offsetParent && (one.offsetHeight < 44 || one.offsetWidth < 44)).map((one) => one.outerHTML).join()",
    );
    assert_eq!(small, "", "everything can be touched");

    page.go("history");
    page.until("document.querySelector('#find-serial')");
    page.value("document.querySelector('#find-serial').focus()");
    page.typed("nothing like it");
    page.key("Enter");
    page.until("document.querySelector('#list').textContent.includes('Nothing found')");

    page.go("measure");
    page.until("document.querySelector('#verdict')?.textContent === 'NOT OK'");
    cell.stop();
    page.until("!document.querySelector('#lost').hidden && document.querySelector('#lost').textContent.includes('No connection')");
    cell.run();
    page.until(
        "document.querySelector('#lost').hidden && !document.querySelector('#start').disabled",
    );
    page.until("document.querySelector('#verdict').textContent === 'NOT OK'");
    page.measured("SN-43");

    page.value("document.querySelector('#language').click()");
    page.until("document.querySelector('#verdict')?.textContent === 'NICHT OK'");
    page.until("document.querySelector('#reason').textContent.includes('außerhalb der Grenzen')");
    page.until("document.querySelector('#result').textContent.includes('Teil beiseitelegen')");
    told_alike(&page);
    page.go("history");
    page.click("#list tbody a");
    page.until("document.querySelector('#report')?.contentDocument?.documentElement.lang === 'de'");
    page.until("document.querySelector('#report').contentDocument.body.textContent.includes('Messunsicherheit')");
    page.go("measure");
    page.until("document.querySelector('#verdict')?.textContent === 'NICHT OK'");
    page.value("document.querySelector('#language').click()");
    shots(&browser, &cell, &page);
}

/// The page and the program tell the same sentence in the same words.
fn told_alike(page: &Seen) {
    let english = [
        "flank 1 (face #12): no points; flank 2 (face #7): 3 points, 8 needed",
        "points only 0.120 to 0.480 mm from the edge, too short a reach to extrapolate",
        "a limit of the edge radius lies inside its uncertainty; a limit of d1 lies inside its uncertainty",
        "alignment: the data do not hold along x, rotation about (0.10, 0.20, 0.97), which moves edge e1; scan another face",
        "the cell is not ready: device \"left\": /dev/ttyUSB0: no such file; look at the cable",
        "not begun: halted by no points; Ada",
        "said by nobody: 1.5; of us",
        "",
    ];
    page.value(&format!(
        "(import('/page/text.js').then((text) => {{ window.told = JSON.stringify({}.map(text.said)); }}), 1)",
        serde_json::to_string(&english).expect("texts")
    ));
    page.until("window.told");
    let told: Vec<String> = serde_json::from_str(&page.value("told")).expect("texts");
    assert_eq!(told, english.map(|sentence| Language::De.said(sentence)));
}

#[test]
fn a_role_is_shown_what_it_may_use() {
    let Some(browser) = browser() else { return };
    let cell = Served::without_devices("browser-roles", |_| ());
    people(&cell);
    let page = Seen::open(&browser, &cell);
    let operator = "measure history trends devices recipes";
    assert_eq!(page.places(), operator);
    page.go("recipes/1");
    page.until("document.querySelector('#text')");
    assert_eq!(
        page.value("document.querySelector('#text').readOnly"),
        "true"
    );
    assert_eq!(page.value("document.querySelector('#check')"), "null");
    page.go("people");
    page.until("document.querySelector('#login-here')");

    page.login("setter");
    assert_eq!(page.places(), operator);
    page.go("recipes/1");
    page.click("#check");
    page.until("document.querySelector('#checked').textContent.includes('sharp edges')");
    page.value("(() => { const text = document.querySelector('#text'); text.value = text.value.replace('-0.040, 0.040', '-0.050, 0.050'); return 1; })()");
    page.click("#keep");
    page.until("document.activeElement.id === 'why'");
    page.typed("wider limits");
    page.key("Enter");
    page.click("#activate");
    page.until("document.activeElement.id === 'why'");
    page.typed("drawing B");
    page.key("Enter");
    page.until("document.querySelector('#dialog').textContent.includes('metrologist')");
    page.click("#dialog button[type=button]");

    page.click("#person");
    page.click("#dialog button.main");
    page.until("document.querySelector('#person').textContent === 'Log in'");
    page.login("metrologist");
    page.click("#activate");
    page.until("document.activeElement.id === 'why'");
    page.typed("drawing B");
    page.key("Enter");
    page.until("document.querySelectorAll('#list tbody tr').length === 2 && document.querySelector('#list tbody tr').textContent.includes('active')");

    page.click("#person");
    page.click("#dialog button.main");
    page.until("document.querySelector('#person').textContent === 'Log in'");
    page.login("administrator");
    assert_eq!(page.places(), format!("{operator} audit people"));
    page.go("audit");
    page.until("document.querySelector('#list')?.textContent.includes('drawing B')");
    page.go("people");
    page.until("document.querySelectorAll('#list tbody tr').length === 4");
    page.click("#add");
    page.until("document.activeElement.name === 'name'");
    page.typed("ada");
    page.key("Tab");
    page.key("Tab");
    page.typed("a long sentence");
    page.key("Enter");
    page.until("document.querySelectorAll('#list tbody tr').length === 5");
    let raw = page.value("document.body.innerText.match(/\\b[a-z]+\\.[a-z.]+\\b/g)?.filter((word) => !word.includes('session.') && !word.includes('person.')) ?? ''");
    assert_eq!(raw, "", "every text has its words");
}

/// Pictures of every page, for people to look at.
fn shots(browser: &Browser, cell: &Served, operator: &Seen) {
    let Some(folder) = std::env::var_os("ACIES_SCREENSHOTS").map(PathBuf::from) else {
        return;
    };
    std::fs::create_dir_all(&folder).expect("a folder for the pictures");
    for (name, width, height) in [("desktop", 1440, 900), ("tablet", 1024, 768)] {
        for scheme in ["light", "dark"] {
            sized(&operator.tab, width, height, scheme);
            operator.go("measure");
            operator.until("document.querySelectorAll('#result li').length > 0");
            shot(&operator.tab, &folder, &format!("measure-{name}-{scheme}"));
        }
    }
    let page = Seen::open(browser, cell);
    page.login("administrator");
    let last = cell.handle().snapshot().last.as_ref().expect("a result").id;
    let name = page.value("fetch('/api/v1/characteristics').then((a) => a.json()).then((a) => { window.first = a.find((n) => n === 'foot of the wall.d1'); })");
    assert!(!name.is_empty());
    page.until("window.first");
    let trend = format!("trends/{}", page.value("encodeURIComponent(first)"));
    let inspection = format!("inspection/{last}");
    let places = [
        ("history", "document.querySelector('#list tbody tr')"),
        (
            inspection.as_str(),
            "document.querySelectorAll('tbody tr').length > 5 && document.querySelector('#report').contentDocument.readyState === 'complete'",
        ),
        (trend.as_str(), "document.querySelector('.chart')"),
        ("devices", "document.querySelector('.device')"),
        ("recipes/1", "document.querySelector('#text')"),
        ("audit", "document.querySelector('#list tbody tr')"),
        ("people", "document.querySelector('#list tbody tr')"),
    ];
    for (name, width, height) in [("desktop", 1440, 900), ("tablet", 1024, 768)] {
        for scheme in ["light", "dark"] {
            sized(&page.tab, width, height, scheme);
            for (place, there) in places {
                page.go(place);
                page.until(there);
                let word = place.split('/').next().unwrap_or(place);
                shot(&page.tab, &folder, &format!("{word}-{name}-{scheme}"));
            }
        }
    }
    page.click("#person");
    shot(&page.tab, &folder, "dialog");
    assert!(page.root.starts_with("http://"));
}

fn sized(tab: &Tab, width: u32, height: u32, scheme: &str) {
    let metrics = Emulation::SetDeviceMetricsOverride {
        width,
        height,
        device_scale_factor: 1.0,
        mobile: false,
        scale: None,
        screen_width: None,
        screen_height: None,
        position_x: None,
        position_y: None,
        dont_set_visible_size: None,
        screen_orientation: None,
        viewport: None,
        display_feature: None,
        device_posture: None,
    };
    tab.call_method(metrics).expect("a size");
    let media = Emulation::SetEmulatedMedia {
        media: None,
        features: Some(vec![Emulation::MediaFeature {
            name: "prefers-color-scheme".to_owned(),
            value: scheme.to_owned(),
        }]),
    };
    tab.call_method(media).expect("a colour scheme");
}

fn shot(tab: &Tab, folder: &Path, name: &str) {
    let png = tab.capture_screenshot(Page::CaptureScreenshotFormatOption::Png, None, None, true);
    let png = png.expect("a picture");
    std::fs::write(folder.join(format!("{name}.png")), png).expect("a file");
}

//! The forms for people: what they say, and that no text from outside breaks them.

use std::path::Path;

use acies::report::{Report, print_table};
use acies::words::Language;
use proptest::prelude::*;

use super::part;

#[test]
fn the_terminal_table_fits_a_terminal() {
    let table = print_table(&super::report(), false);
    let edges = table.lines().take_while(|line| !line.is_empty());
    for line in edges {
        assert!(line.chars().count() <= 110, "{line}");
    }
    insta::assert_snapshot!("table", table);
}

#[test]
fn colour_adds_nothing_but_colour() {
    let coloured = print_table(&super::report(), true);
    assert!(coloured.contains("\x1b[1;31mNOT OK\x1b[0m"));
    let mut plain = String::new();
    let mut rest = coloured.as_str();
    while let Some((before, after)) = rest.split_once('\x1b') {
        plain.push_str(before);
        rest = after.split_once('m').map_or("", |(_, after)| after);
    }
    plain.push_str(rest);
    assert_eq!(plain, print_table(&super::report(), false));
}

#[test]
fn csv_is_one_row_a_station() {
    let report = Report::new(&part::inspection(6), &part::facts());
    let csv = report.to_csv();
    insta::assert_snapshot!("csv", csv.lines().take(32).collect::<Vec<_>>().join("\n"));
    let rows = parse_csv(&csv);
    assert_eq!(rows.len(), 1 + 11 * 6);
    let column = |name: &str| {
        rows[0]
            .iter()
            .position(|c| c == name)
            .expect("the header names it")
    };
    let hole = &rows[1 + 4 * 6 + 2];
    assert_eq!(hole[column("d1_mm")], "", "not measured is empty, not zero");
    assert_eq!(hole[column("measured_x_mm")], "");
}

#[test]
fn the_page_says_what_the_operator_needs() {
    insta::assert_snapshot!("page", text_of(&super::report().to_html(Language::En)));
}

#[test]
fn the_page_is_german_where_that_is_asked_for() {
    let german = text_of(&super::report().to_html(Language::De));
    insta::assert_snapshot!("page_de", german);
    let texts = include_str!("../../src/words/texts.json");
    let texts: serde_json::Value = serde_json::from_str(texts).expect("the table");
    let words = |text: &str| {
        let words = text.split_whitespace();
        words
            .filter(|word| word.chars().any(char::is_alphabetic))
            .count()
    };
    let mut looked = 0;
    for (key, english) in texts["en"].as_object().expect("texts by key") {
        let english = english.as_str().expect("a text");
        if texts["de"][key] == english {
            continue;
        }
        // Between the places to fill: three words or more are no chance.
        for part in english
            .split(['{', '}'])
            .step_by(2)
            .filter(|part| words(part) >= 3)
        {
            looked += 1;
            assert!(
                !german.contains(part.trim()),
                "{key}: {part:?} in the German page"
            );
        }
    }
    assert!(looked > 300, "{looked} texts");
}

#[test]
fn numbers_of_the_german_page_have_a_decimal_comma() {
    let german = text_of(&super::report().to_html(Language::De));
    let point = |line: &&str| {
        let bytes = line.as_bytes();
        (1..bytes.len().saturating_sub(1)).any(|at| {
            bytes[at] == b'.' && bytes[at - 1].is_ascii_digit() && bytes[at + 1].is_ascii_digit()
        })
    };
    // Versions of firmware and of the program are names.
    let names = ["Erstellt von", "Acies"];
    let left: Vec<&str> = german
        .lines()
        .filter(point)
        .filter(|line| !names.iter().any(|name| line.contains(name)))
        .collect();
    assert_eq!(left, Vec::<&str>::new());
}

#[test]
fn the_page_asks_the_network_for_nothing() {
    let page = super::report().to_html(Language::En);
    for reference in [
        "http:", "https:", "src=", "@import", "url(http", "<link", "<iframe",
    ] {
        let found = page
            .find(reference)
            .map(|at| &page[at..(at + 60).min(page.len())]);
        assert_eq!(found, None, "{reference}");
    }
}

#[test]
fn each_verdict_has_its_own_reason_and_advice() {
    let mut inspection = part::inspection(20);
    let facts = part::facts();
    let said = |report: &Report| format!("{}; {}", report.reason, report.advice);

    let not_ok = Report::new(&inspection, &facts);
    assert!(
        said(&not_ok).starts_with("e2: d1 is +13"),
        "{}",
        said(&not_ok)
    );
    assert!(
        said(&not_ok).contains("outside its limits (−100 to +100 µm)"),
        "{}",
        said(&not_ok)
    );

    inspection.edges.remove(1);
    inspection.verdict = inspection
        .edges
        .iter()
        .map(|e| e.verdict)
        .max()
        .expect("edges");
    let zone = said(&Report::new(&inspection, &facts));
    assert!(
        zone.contains("a limit lies inside this uncertainty"),
        "{zone}"
    );

    inspection.edges.retain(|edge| edge.id != "e3");
    let gap = said(&Report::new(&inspection, &facts));
    assert!(
        gap.contains("of the edge was measured (no points on either flank"),
        "{gap}"
    );
    assert!(gap.contains("scan the missing stretches again"), "{gap}");

    inspection.edges.retain(|edge| edge.coverage == 1.0);
    inspection.verdict = acies::inspect::result::Verdict::Ok;
    let ok = said(&Report::new(&inspection, &facts));
    assert!(
        ok.starts_with("all 21 values are within their limits; nearest to one is e"),
        "{ok}"
    );

    inspection.alignment.status = acies::inspect::result::Verdict::NotDecidable;
    inspection.alignment.weak_directions = vec!["along x".to_owned()];
    let weak = said(&Report::new(&inspection, &facts));
    assert!(
        weak.starts_with("the scan holds the part only weakly: along x"),
        "{weak}"
    );

    inspection.alignment.status = acies::inspect::result::Verdict::Ok;
    inspection.edges.clear();
    inspection.verdict = acies::inspect::result::Verdict::NotOk;
    inspection.missing_edges = vec!["e7".to_owned()];
    let missing = said(&Report::new(&inspection, &facts));
    assert!(
        missing.starts_with("the scan has no edge where the nominal has e7"),
        "{missing}"
    );
}

#[test]
fn values_without_limits_are_stated_and_not_judged() {
    let mut inspection = part::inspection(4);
    for edge in &mut inspection.edges {
        edge.verdict = acies::inspect::result::Verdict::Undefined;
    }
    inspection.verdict = acies::inspect::result::Verdict::Ok;
    let mut facts = part::facts();
    facts.recipe = Default::default();
    part::judge_again(&mut inspection, &facts.recipe);
    let report = Report::new(&inspection, &facts);
    assert_eq!(report.verdict, acies::report::wire::Status::Undefined);
    assert_eq!(report.advice, "give limits in a recipe to get a verdict");
}

#[test]
fn a_report_without_edges_still_has_every_form() {
    let mut inspection = part::inspection(3);
    inspection.edges.clear();
    inspection.verdict = acies::inspect::result::Verdict::Undefined;
    let report = Report::new(&inspection, &part::facts());
    assert!(
        text_of(&report.to_html(Language::En))
            .contains("The nominal has no sharp edge to measure.")
    );
    assert_eq!(parse_csv(&report.to_csv()).len(), 1);
    let told = "not judged: the nominal has no sharp edge to measure; check that the right nominal was given
";
    assert!(
        print_table(&report, false).ends_with(told),
        "a good alignment alone makes no part OK"
    );
}

#[test]
fn the_ending_decides_the_form_and_the_file_is_whole() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("forms");
    std::fs::create_dir_all(&folder).expect("the target folder can be written");
    let report = super::report();
    for (name, text) in [
        ("r.json", report.to_json()),
        ("r.HTML", report.to_html(Language::En)),
        ("r.csv", report.to_csv()),
    ] {
        let path = folder.join(name);
        report
            .write_atomically(&path, Language::En)
            .expect("it can be written");
        assert_eq!(std::fs::read_to_string(&path).expect("it is there"), text);
    }
    let left = std::fs::read_dir(&folder).expect("it is a folder").count();
    assert_eq!(left, 3, "no temporary file stays");
}

#[test]
fn a_report_that_cannot_be_written_says_why() {
    let report = super::report();
    let error = |path: &str| {
        report
            .write_atomically(Path::new(path), Language::En)
            .expect_err("it cannot be written")
            .to_string()
    };
    assert_eq!(
        error("out.pdf"),
        "out.pdf: the ending is .pdf, expected .json, .html or .csv; name the file after the form you want"
    );
    assert!(error("out").starts_with("out: the ending is missing, expected .json"));
    let nowhere = error("no/such/folder/out.json");
    assert!(
        nowhere.starts_with("no/such/folder/out.json: cannot be written: "),
        "{nowhere}"
    );
    assert!(
        nowhere.contains("check that the folder exists"),
        "{nowhere}"
    );
}

/// A report in which every text from outside is `text`.
fn report_saying(text: &str) -> Report {
    let mut inspection = part::inspection(8);
    inspection.edges.truncate(3);
    for edge in &mut inspection.edges {
        edge.id = text.to_owned();
        edge.stations[2].reason = text.to_owned();
    }
    inspection.findings = vec![text.to_owned()];
    inspection.missing_edges = vec![text.to_owned()];
    inspection.alignment.weak_directions = vec![text.to_owned()];
    let mut facts = part::facts();
    facts.part = text.to_owned();
    facts.nominal = text.to_owned();
    let device = &mut facts.devices[0];
    device.name = text.to_owned();
    device.identity.vendor = text.to_owned();
    device.identity.model = text.to_owned();
    device.identity.serial = text.to_owned();
    device.identity.firmware = text.to_owned();
    Report::new(&inspection, &facts)
}

fn hostile() -> impl Strategy<Value = String> {
    let piece = prop_oneof![
        Just("<script>alert(1)</script>".to_owned()),
        Just("</style></title><!--".to_owned()),
        Just("\" onload='x' ".to_owned()),
        Just("&amp;&#60;".to_owned()),
        Just("=cmd|' /C calc'!A0".to_owned()),
        Just(",;\"\"\r\n\t\0\u{7f}\u{85}".to_owned()),
        Just("\u{202e}Ünï→𝔘\u{2028}".to_owned()),
        any::<String>(),
    ];
    proptest::collection::vec(piece, 1..4).prop_map(|pieces| format!("x{}", pieces.concat()))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_text_changes_the_structure_of_the_page(text in hostile()) {
        let report = report_saying(&text);
        let page = report.to_html(Language::En);
        prop_assert_eq!(tags(&page), tags(&report_saying("x").to_html(Language::En)));
        let (_, rest) = page.split_once("id=\"view-data\">").expect("the data of the view");
        let (data, _) = rest.split_once("</script>").expect("it ends");
        let data: serde_json::Value = serde_json::from_str(data).expect("it is JSON");
        prop_assert_eq!(data["edges"][0]["id"].as_str(), Some(text.as_str()));
    }

    #[test]
    fn no_text_changes_the_rows_of_the_csv(text in hostile()) {
        let rows = parse_csv(&report_saying(&text).to_csv());
        prop_assert_eq!(rows.len(), 1 + 3 * 8);
        for row in &rows {
            prop_assert_eq!(row.len(), rows[0].len());
        }
        let line: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        prop_assert_eq!(&rows[1][0], &line);
        for cell in rows.iter().flatten() {
            let formula = cell.starts_with(['=', '@', '+']) || (cell.starts_with('-') && cell.parse::<f64>().is_err());
            prop_assert!(!formula, "{cell} would run in a spreadsheet");
        }
    }

    #[test]
    fn no_text_adds_a_line_or_an_escape_to_the_table(text in hostile()) {
        let table = print_table(&report_saying(&text), false);
        prop_assert_eq!(table.lines().count(), 1 + 3 + 2);
        prop_assert!(!table.contains('\x1b'));
    }

    #[test]
    fn no_number_that_is_none_reaches_any_form(
        bad in prop_oneof![Just(f64::NAN), Just(f64::INFINITY), Just(f64::NEG_INFINITY), Just(1e308), Just(-1e200)],
        place in 0..20usize,
        station in 0..8usize,
    ) {
        let mut inspection = part::inspection(8);
        let mut facts = part::facts();
        inspection.edges.truncate(3);
        part::spoil(&mut inspection, &mut facts, (place, station), bad);
        let report = Report::new(&inspection, &facts);
        let json = serde_json::to_value(&report).expect("it is JSON");
        let schema = Report::json_schema();
        prop_assert_eq!(super::schema::check(&schema, &schema, &json), Ok(()));
        if (1..=8).contains(&place) {
            let hit = &report.edges[0];
            prop_assert!(hit.verdict >= acies::report::wire::Status::NotDecidable, "{:?}", hit.verdict);
            let said = &hit.stations[station].reason;
            prop_assert!(said.contains("is not a number below 1e9"), "{said}");
        }
        for form in [report.to_html(Language::En), report.to_csv(), print_table(&report, false)] {
            // `Infinity` and `NaN` are no words of ours; the script has neither.
            prop_assert!(!form.contains("NaN") && !form.contains("inf,") && !form.contains("inf "));
            prop_assert!(form.len() < 200_000, "no number of 300 digits");
        }
    }
}

/// Names of all tags in order, read as a browser does: quoted attributes may hold `>`.
fn tags(page: &str) -> Vec<String> {
    let mut names = Vec::new();
    let mut rest = page;
    while let Some((_, after)) = rest.split_once('<') {
        let end = after
            .find(|c: char| c.is_whitespace() || c == '>')
            .unwrap_or(after.len());
        names.push(after[..end].to_owned());
        let mut quote = None;
        let close = after.find(|c| {
            match (quote, c) {
                (None, '"' | '\'') => quote = Some(c),
                (Some(open), c) if open == c => quote = None,
                (None, '>') => return true,
                _ => {}
            }
            false
        });
        rest = &after[close.map_or(after.len(), |at| at + 1)..];
        if ["script", "style"].contains(&names[names.len() - 1].as_str()) {
            let end = format!("</{}", names[names.len() - 1]);
            rest = &rest[rest.find(&end).unwrap_or(rest.len())..];
        }
    }
    names
}

/// What a reader sees of the page: text without drawings, one line a block.
fn text_of(page: &str) -> String {
    let mut text = String::new();
    let mut hidden: Option<&str> = None;
    for piece in page.split('<').skip(1) {
        let name = piece
            .split([' ', '>', '/'])
            .find(|n| !n.is_empty())
            .unwrap_or("");
        match hidden {
            Some(element) if piece.starts_with('/') && name == element => hidden = None,
            Some(_) => continue,
            None => hidden = ["svg", "style", "script"].into_iter().find(|e| *e == name),
        }
        let block = [
            "p", "tr", "h1", "h2", "h3", "h4", "li", "section", "figure", "summary",
        ];
        if block.contains(&name) && !text.ends_with('\n') {
            text.push('\n');
        }
        if hidden.is_none() {
            let words = piece.split_once('>').map_or("", |(_, words)| words);
            text.push_str(words.trim_end_matches('\n'));
            if matches!(name, "td" | "th") && !text.ends_with([' ', '\n']) {
                text.push_str(" | ");
            }
        }
    }
    text.lines()
        .map(str::trim)
        .filter(|line| !line.is_empty())
        .collect::<Vec<_>>()
        .join("\n")
}

/// RFC 4180, by the letter.
fn parse_csv(text: &str) -> Vec<Vec<String>> {
    let mut rows = vec![vec![String::new()]];
    let mut quoted = false;
    let mut chars = text.chars().peekable();
    while let Some(c) = chars.next() {
        let row = rows.last_mut().expect("never empty");
        match c {
            '"' if quoted && chars.peek() == Some(&'"') => {
                chars.next();
                row.last_mut().expect("never empty").push('"');
            }
            '"' => quoted = !quoted,
            ',' if !quoted => row.push(String::new()),
            '\r' if !quoted && chars.peek() == Some(&'\n') => {
                chars.next();
                rows.push(vec![String::new()]);
            }
            c => row.last_mut().expect("never empty").push(c),
        }
    }
    assert_eq!(
        rows.pop(),
        Some(vec![String::new()]),
        "the last row ends with CRLF"
    );
    rows
}

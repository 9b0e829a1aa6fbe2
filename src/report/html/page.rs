//! What every part of the page uses: its paper with its language, escaping, words and signs of a verdict, figures.

use std::fmt;

use crate::report::because::code;
use crate::report::figure::Figure;
use crate::report::wire::{Quantity, Status};
use crate::words::Language;

/// The page as it is written, in one language.
pub struct Paper {
    /// What is written so far.
    pub text: String,
    /// The language.
    pub words: Language,
}

impl fmt::Write for Paper {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.text.push_str(text);
        Ok(())
    }
}

impl Paper {
    /// Writes markup of ours in which `[[key]]` stands for the text `report.key`.
    pub fn put(&mut self, markup: &'static str) -> fmt::Result {
        use fmt::Write as _;
        let mut rest = markup;
        while let Some((before, after)) = rest.split_once("[[") {
            let (key, after) = after.split_once("]]").unwrap_or((after, ""));
            write!(self, "{before}{}", Escaped(&self.t(key)))?;
            rest = after;
        }
        self.write_str(rest)
    }

    /// The text `report.key`.
    pub fn t(&self, key: &str) -> String {
        self.with(key, &[])
    }

    /// The same with its {names} filled in.
    pub fn with(&self, key: &str, values: &[(&str, &str)]) -> String {
        self.words.fill(&format!("report.{key}"), values)
    }

    /// A number with so many digits behind the decimal sign.
    pub fn number(&self, value: f64, digits: usize) -> String {
        self.words.number(&format!("{value:.digits$}"))
    }

    /// A value with its uncertainty as the language writes it.
    pub fn figure(&self, quantity: Quantity, value: f64, u: Option<f64>) -> Figure {
        Figure::of(quantity, value, u).told(self.words)
    }

    /// Sign and word of a verdict.
    pub fn state(&self, status: Status) -> State {
        State(status, self.words)
    }
}

/// Text from outside, made safe for HTML text and quoted attributes; control characters become spaces.
pub struct Escaped<'a>(pub &'a str);

impl fmt::Display for Escaped<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        use fmt::Write as _;
        for c in self.0.chars() {
            match c {
                '&' => f.write_str("&amp;")?,
                '<' => f.write_str("&lt;")?,
                '>' => f.write_str("&gt;")?,
                '"' => f.write_str("&quot;")?,
                '\'' => f.write_str("&#39;")?,
                c if c.is_control() => f.write_char(' ')?,
                c => f.write_char(c)?,
            }
        }
        Ok(())
    }
}

/// The word for a verdict.
pub fn word(words: Language, status: Status) -> String {
    words.fill(&format!("verdict.report.{}", code(&status)), &[])
}

/// The name of a verdict in class names and in the data of the 3D view.
pub fn class(status: Status) -> &'static str {
    match status {
        Status::Ok => "ok",
        Status::NotOk => "not_ok",
        Status::NotDecidable => "not_decidable",
        Status::Undefined => "undefined",
    }
}

/// Sign and word of a verdict, so that colour is never alone.
pub struct State(Status, Language);

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (class, word) = (class(self.0), word(self.1, self.0));
        write!(
            f,
            r##"<span class="state c-{class}"><svg aria-hidden="true" viewBox="0 0 24 24"><use href="#i-{class}"/></svg>{word}</span>"##
        )
    }
}

/// `+152 <span>± 12</span>`.
pub struct PlusMinus<'a>(pub &'a Figure);

impl fmt::Display for PlusMinus<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0.value)?;
        match &self.0.expanded {
            Some(expanded) => write!(f, r#" <span class="pm">± {expanded}</span>"#),
            None => Ok(()),
        }
    }
}

/// The signs of the verdicts and the hatching of holes, referred to by the rest of the page.
pub const SYMBOLS: &str = r##"<svg width="0" height="0" aria-hidden="true" focusable="false"><defs>
<symbol id="i-ok" viewBox="0 0 24 24"><circle cx="12" cy="12" r="10.5" fill="none" stroke="currentColor" stroke-width="2.4"/><path d="M7 12.5l3.5 3.5L17 8.5" fill="none" stroke="currentColor" stroke-width="2.8"/></symbol>
<symbol id="i-not_ok" viewBox="0 0 24 24"><path d="M7.5 1.5h9l6 6v9l-6 6h-9l-6-6v-9z" fill="none" stroke="currentColor" stroke-width="2.4"/><path d="M8 8l8 8M16 8l-8 8" fill="none" stroke="currentColor" stroke-width="2.8"/></symbol>
<symbol id="i-not_decidable" viewBox="0 0 24 24"><path d="M12 2l10.5 19h-21z" fill="none" stroke="currentColor" stroke-width="2.4" stroke-linejoin="round"/><path d="M9.6 11.2c0-3 4.8-3 4.8 0 0 1.8-2.4 1.6-2.4 3.6M12 17v2" fill="none" stroke="currentColor" stroke-width="2"/></symbol>
<symbol id="i-undefined" viewBox="0 0 24 24"><circle cx="12" cy="12" r="10.5" fill="none" stroke="currentColor" stroke-width="2.4" stroke-dasharray="4 3"/><path d="M7 12h10" stroke="currentColor" stroke-width="2.8"/></symbol>
<pattern id="hatch" width="7" height="7" patternUnits="userSpaceOnUse" patternTransform="rotate(45)"><path class="hatch" d="M0 0v7"/></pattern>
</defs></svg>
"##;

//! What a bench leaves behind: NAME.html, which needs no other file, NAME.json, and a csv for each table.
//!
//! A table is declared once and written in four forms: csv, json, a table of the page, and Markdown for the terminal and
//! README.md. A figure stands in the unit of its column in all of them; json alone has all its digits. What was not
//! measured is empty in csv, `null` in json and a dash elsewhere.

use serde_json::{json, Map, Value};
use std::fmt::Write as _;
use std::io::{self, Write};
use stipple::output::chart::escape;
use stipple::output::html;
use stipple::output::panel::Picture;
use stipple::output::OutputDir;
use stipple_drivers::Fault;

/// Style added to that of the reports: series of ink 3 are points without a line, of which only a first dot stays, for the
/// legend.
pub const STYLE: &str = ".line.ink3 { stroke-width: 5.2; stroke-dasharray: 0 9999; } .dot.ink3 { fill: var(--ink3); opacity: .6; } \
    .wide-table { overflow-x: auto; } .wide-table td, .wide-table th { padding-left: 10px; font-size: 13.5px; } \
    .wide-table td { font-weight: 400; } tr.marked td, tr.marked th { font-weight: 700; } \
    thead th { text-align: right; color: var(--soft); border-top: 0; } .wide-table th:first-child { text-align: left; padding-left: 0; }";
/// Widest picture within the page, px.
const PICTURE_MAX: usize = 1200;
const DASH: &str = "\u{2013}";

pub struct Page {
    /// Stem of the files.
    pub name: &'static str,
    pub title: &'static str,
    /// One line below the title.
    pub what: String,
    /// Figures of the whole, for json.
    pub facts: Vec<(&'static str, Value)>,
    pub parts: Vec<Part>,
}

pub enum Part {
    Note(String),
    /// Title and drawings; those that have no point are `None`.
    Charts(&'static str, Vec<Option<String>>),
    Table(Table),
    /// Caption and picture.
    Picture(String, Picture),
}

/// A column: its name, its unit, and how its figures are shown.
#[derive(Clone, Copy, Debug)]
pub struct Head {
    name: &'static str,
    unit: &'static str,
    digits: usize,
    /// Units in what is measured: 1000 where metres are shown in mm.
    scale: f64,
}

pub const fn text(name: &'static str) -> Head {
    number(name, "", 0)
}

pub const fn count(name: &'static str) -> Head {
    number(name, "", 0)
}

pub const fn number(name: &'static str, unit: &'static str, digits: usize) -> Head {
    Head { name, unit, digits, scale: 1.0 }
}

/// A column of what is measured in metres.
pub const fn millimetres(name: &'static str, digits: usize) -> Head {
    Head { scale: 1e3, ..number(name, "mm", digits) }
}

/// A column of what is measured as a share.
pub const fn percent(name: &'static str, digits: usize) -> Head {
    Head { scale: 100.0, ..number(name, "%", digits) }
}

/// A column of what is measured in bytes.
pub const fn mebibytes(name: &'static str) -> Head {
    Head { scale: 1.0 / 1048576.0, ..number(name, "MiB", 1) }
}

impl Head {
    fn text(&self) -> String {
        if self.unit.is_empty() {
            self.name.to_string()
        } else {
            format!("{}, {}", self.name, self.unit)
        }
    }

    /// The heading as one word, for csv and json: `jump_mm`.
    fn key(&self) -> String {
        let words = self.text().replace('%', "percent").replace('/', " per ").to_lowercase();
        words.split(|c: char| !c.is_ascii_alphanumeric()).filter(|w| !w.is_empty()).collect::<Vec<_>>().join("_")
    }
}

#[derive(Clone, Debug, PartialEq)]
pub enum Cell {
    Text(String),
    Number(Option<f64>),
}

macro_rules! cell_from {
    ($($from:ty, $v:ident => $cell:expr);+ $(;)?) => {
        $(impl From<$from> for Cell {
            fn from($v: $from) -> Cell {
                $cell
            }
        })+
    };
}

cell_from! {
    &str, v => Cell::Text(v.to_string());
    String, v => Cell::Text(v);
    Option<f64>, v => Cell::Number(v);
    f64, v => Cell::Number(Some(v));
    Option<u64>, v => Cell::Number(v.map(|n| n as f64));
    u64, v => Cell::from(Some(v));
    usize, v => Cell::from(v as u64);
    u32, v => Cell::from(u64::from(v));
    u8, v => Cell::from(u64::from(v));
}

/// Declares a table: name, title, rows, `|row| whether it is marked`, and each column with the cell it has of the row.
#[macro_export]
macro_rules! table {
    ($name:expr, $title:expr, $rows:expr, |$row:ident| $marked:expr, [$($head:expr => $cell:expr),+ $(,)?]) => {
        $crate::page::Table::new($name, $title, $rows, &[$($head),+], |$row| {
            ($marked, vec![$($crate::page::Cell::from($cell)),+])
        })
    };
}

pub struct Table {
    /// Stem of the csv, key in json.
    name: &'static str,
    title: String,
    heads: Vec<Head>,
    /// Marked rows are bold on the page.
    rows: Vec<(bool, Vec<Cell>)>,
}

impl Table {
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// `cells` answers whether a row is marked, and a cell a column.
    pub fn new<T>(
        name: &'static str,
        title: &str,
        rows: impl IntoIterator<Item = T>,
        heads: &[Head],
        cells: impl FnMut(T) -> (bool, Vec<Cell>),
    ) -> Table {
        let rows: Vec<_> = rows.into_iter().map(cells).collect();
        assert!(rows.iter().all(|r| r.1.len() == heads.len()), "a cell a column of `{name}`");
        Table { name, title: title.to_string(), heads: heads.to_vec(), rows }
    }

    /// Each cell of a row as it is read, with what stands for nothing.
    fn shown<'a>(&'a self, cells: &'a [Cell], nothing: &'a str) -> impl Iterator<Item = String> + 'a {
        self.heads.iter().zip(cells).map(move |(head, cell)| match cell {
            Cell::Text(text) if !text.is_empty() => text.clone(),
            Cell::Number(Some(v)) if v.is_finite() => format!("{:.1$}", v * head.scale, head.digits),
            Cell::Text(_) | Cell::Number(_) => nothing.to_string(),
        })
    }

    fn csv(&self, out: &mut impl Write) -> io::Result<()> {
        let quoted = |s: String| if s.contains([',', '"']) { format!("\"{}\"", s.replace('"', "\"\"")) } else { s };
        writeln!(out, "{}", self.heads.iter().map(Head::key).collect::<Vec<_>>().join(","))?;
        for (_, cells) in &self.rows {
            writeln!(out, "{}", self.shown(cells, "").map(quoted).collect::<Vec<_>>().join(","))?;
        }
        Ok(())
    }

    fn json(&self) -> Value {
        let value = |(head, cell): (&Head, &Cell)| match cell {
            Cell::Text(text) => (head.key(), json!(text)),
            Cell::Number(v) => (head.key(), json!(v.map(|v| v * head.scale))),
        };
        self.rows.iter().map(|(_, cells)| self.heads.iter().zip(cells).map(value).collect::<Map<_, _>>()).collect()
    }

    /// The table in Markdown.
    pub fn text(&self) -> String {
        let head: Vec<String> = self.heads.iter().map(Head::text).collect();
        let rows: Vec<Vec<String>> = self.rows.iter().map(|(_, cells)| self.shown(cells, "-").collect()).collect();
        let wide = |k: usize| rows.iter().chain([&head]).map(|r| r[k].chars().count()).max().unwrap_or(0);
        let widths: Vec<usize> = (0..head.len()).map(wide).collect();
        let line = |cells: &[String]| {
            cells.iter().zip(&widths).fold("|".to_string(), |line, (cell, n)| line + &format!(" {cell:<n$} |"))
        };
        let rule = widths.iter().fold("|".to_string(), |line, n| line + &"-".repeat(n + 2) + "|");
        [line(&head), rule].into_iter().chain(rows.iter().map(|r| line(r))).collect::<Vec<_>>().join("\n")
    }

    fn html(&self) -> String {
        let title = escape(&self.title);
        let mut html = format!("<section><h2>{title}</h2><div class=\"wide-table\"><table><thead><tr>");
        for head in &self.heads {
            let _ = write!(html, "<th scope=\"col\">{}</th>", escape(&head.text()));
        }
        html.push_str("</tr></thead>");
        for (marked, cells) in &self.rows {
            html.push_str(if *marked { "<tr class=\"marked\">" } else { "<tr>" });
            for (i, cell) in self.shown(cells, DASH).enumerate() {
                let (tag, cell) = (if i == 0 { "th" } else { "td" }, escape(&cell));
                let _ = write!(html, "<{tag}>{cell}</{tag}>");
            }
            html.push_str("</tr>");
        }
        html + "</table></div></section>"
    }
}

impl Page {
    fn tables(&self) -> impl Iterator<Item = &Table> {
        self.parts.iter().filter_map(|part| if let Part::Table(table) = part { Some(table) } else { None })
    }

    /// Writes the files.
    pub fn write(&self, out: &OutputDir) -> Result<(), Fault> {
        for table in self.tables() {
            out.write(&format!("{}.csv", table.name), |w| table.csv(w))?;
        }
        let facts = self.facts.iter().map(|(name, fact)| (name.to_string(), fact.clone()));
        let whole: Map<_, _> = facts.chain(self.tables().map(|t| (t.name.to_string(), t.json()))).collect();
        out.write(&format!("{}.json", self.name), |w| {
            serde_json::to_writer_pretty(&mut *w, &whole)?;
            writeln!(w)
        })?;
        out.write(&format!("{}.html", self.name), |w| self.html(w))
    }

    /// Writes the files; prints every table and where the page is.
    pub fn finish(&self, out: &OutputDir) -> Result<(), Fault> {
        self.write(out)?;
        self.tables().for_each(|table| println!("{}\n", table.text()));
        println!("{}", out.file(&format!("{}.html", self.name)).display());
        Ok(())
    }

    fn html(&self, out: &mut impl Write) -> io::Result<()> {
        html::head(out, self.title, &escape(&self.what), STYLE)?;
        for part in &self.parts {
            match part {
                Part::Note(text) => write!(out, "<p class=\"note\">{}</p>", escape(text))?,
                Part::Charts(title, charts) => html::section(out, title, charts)?,
                Part::Table(table) => out.write_all(table.html().as_bytes())?,
                Part::Picture(caption, picture) => html::figure(out, caption, &picture.shrunk(PICTURE_MAX))?,
            }
        }
        html::foot(out)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn table() -> Table {
        let rows = [("one, two", Some(0.00123), 0.5, 17usize), ("none", None, f64::NAN, 0)];
        table!("cases", "Cases", rows, |r| r.3 > 0, [
            text("case") => r.0,
            millimetres("ATE", 1) => r.1,
            percent("bad 1", 2) => r.2,
            number("one thread", "frames/s", 0) => r.3,
        ])
    }

    #[test]
    fn a_table_says_the_same_in_every_form() {
        let mut csv = vec![];
        table().csv(&mut csv).unwrap();
        assert_eq!(
            String::from_utf8(csv).unwrap(),
            "case,ate_mm,bad_1_percent,one_thread_frames_per_s\n\"one, two\",1.2,50.00,17\nnone,,,0\n"
        );
        let json = table().json();
        assert_eq!((&json[0]["ate_mm"], &json[0]["case"]), (&1.23.into(), &"one, two".into()));
        assert_eq!((&json[1]["ate_mm"], &json[1]["bad_1_percent"]), (&Value::Null, &Value::Null));
        let text = table().text();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[0], "| case     | ATE, mm | bad 1, % | one thread, frames/s |");
        assert_eq!(lines[3], "| none     | -       | -        | 0                    |");
        let html = table().html();
        assert!(html.contains("<tr class=\"marked\"><th>one, two</th><td>1.2</td>") && !html.contains("NaN"), "{html}");
    }

    #[test]
    fn a_page_leaves_json_html_and_a_csv_a_table() {
        let dir = tempfile::tempdir().unwrap();
        let out = OutputDir::create(dir.path()).unwrap();
        let parts = vec![Part::Note("<>".into()), Part::Charts("Drawn", vec![None]), Part::Table(table())];
        let page = Page { name: "bench", title: "T", what: "w".into(), facts: vec![("device", json!("d"))], parts };
        page.write(&out).unwrap();
        let read = |name: &str| std::fs::read_to_string(out.file(name)).unwrap();
        let json: Value = serde_json::from_str(&read("bench.json")).unwrap();
        assert_eq!((&json["device"], &json["cases"][1]["case"]), (&"d".into(), &"none".into()));
        assert!(read("bench.html").contains("&lt;&gt;") && read("cases.csv").lines().count() == 3);
    }
}

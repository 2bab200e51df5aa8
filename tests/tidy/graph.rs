//! Which file sees which, by the paths that its code names.

use super::source::{is_test_file, shipped_code, File};
use std::collections::{BTreeMap, BTreeSet};

type Path = Vec<String>;

/// Every path that begins with `crate::` or `super::`, groups in braces expanded.
pub fn paths(code: &str) -> Vec<Path> {
    let mut found = vec![];
    for start in ["crate::", "super::"] {
        for (at, _) in code.match_indices(start) {
            // Not the middle of a longer path, such as `super::super::x`.
            if !code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':' || c == '$') {
                expand(&code[at..], &mut vec![], &mut found);
            }
        }
    }
    found
}

/// Reads one path, or a group of them, and answers how many bytes it took.
fn expand(text: &str, before: &mut Path, found: &mut Vec<Path>) -> usize {
    let (mut at, depth) = (0, before.len());
    loop {
        at += text[at..].len() - text[at..].trim_start().len();
        if text[at..].starts_with('{') {
            at += 1;
            while !text[at..].trim_start().starts_with('}') && at < text.len() {
                at += expand(&text[at..], before, found);
                at += text[at..].find([',', '}']).map_or(text.len() - at, |i| i);
                at += usize::from(text[at..].starts_with(','));
            }
            at += text[at..].find('}').map_or(0, |i| i + 1);
            break;
        }
        let word: String = text[at..].chars().take_while(|c| c.is_alphanumeric() || *c == '_' || *c == '*').collect();
        at += word.len();
        before.push(word);
        if !text[at..].starts_with("::") {
            found.push(before.clone());
            break;
        }
        at += 2;
        // The turbofish of a generic function ends the path.
        if text[at..].starts_with('<') {
            found.push(before.clone());
            break;
        }
    }
    before.truncate(depth);
    at
}

/// The module of a source file below `root`: `src/map/mod.rs` is ["map"].
fn module(root: &str, path: &str) -> Option<Path> {
    let inside = path.strip_prefix(root)?.strip_suffix(".rs")?;
    let mut parts: Path = inside.split('/').map(str::to_string).collect();
    if parts.last().is_some_and(|last| ["mod", "lib", "main"].contains(&last.as_str())) {
        parts.pop();
    }
    Some(parts)
}

/// Which module's file sees which other, parents and children aside.
pub struct Graph {
    edges: BTreeMap<Path, BTreeSet<Path>>,
}

impl Graph {
    /// The graph of the crate whose sources lie below `root`, which ends with a slash.
    pub fn of(root: &str, all: &[File]) -> Graph {
        let sources = all.iter().filter(|f| f.path.ends_with(".rs") && !is_test_file(f, all));
        let codes: BTreeMap<Path, String> =
            sources.filter_map(|f| Some((module(root, &f.path)?, shipped_code(&f.text)))).collect();
        let mut edges: BTreeMap<Path, BTreeSet<Path>> = BTreeMap::new();
        for (from, code) in &codes {
            let seen = paths(code).into_iter().filter_map(|path| resolve(&codes, from, &path));
            let kin = |to: &Path| to.starts_with(from) || from.starts_with(to);
            edges.insert(from.clone(), seen.filter(|to| !kin(to)).collect());
        }
        Graph { edges }
    }

    /// One line for each pair of files of which each can be reached from the other.
    pub fn circles(&self) -> Vec<String> {
        let mut found = vec![];
        for (from, seen) in &self.edges {
            found.extend(seen.iter().filter(|to| from < to && self.reaches(to, from)).map(|to| {
                format!("{} and {} see each other, directly or through others", from.join("::"), to.join("::"))
            }));
        }
        found
    }

    fn reaches(&self, from: &Path, to: &Path) -> bool {
        let (mut open, mut seen) = (vec![from], BTreeSet::new());
        while let Some(at) = open.pop() {
            if at == to {
                return true;
            }
            if seen.insert(at) {
                open.extend(self.edges.get(at).into_iter().flatten());
            }
        }
        false
    }
}

/// The module of the file that a path leads to; through a re-export to where the name is from.
fn resolve(codes: &BTreeMap<Path, String>, from: &Path, path: &Path) -> Option<Path> {
    let mut at = if path[0] == "crate" { vec![] } else { from.clone() };
    let mut rest = &path[1..];
    if path[0] == "super" {
        at.pop()?;
        while rest.first().is_some_and(|p| p == "super") {
            at.pop()?;
            rest = &rest[1..];
        }
    }
    while let Some(next) = rest.first() {
        let deeper = [&at[..], std::slice::from_ref(next)].concat();
        if !codes.contains_key(&deeper) {
            break;
        }
        (at, rest) = (deeper, &rest[1..]);
    }
    let name = rest.first()?;
    let child = codes.keys().filter(|m| m.len() == at.len() + 1 && m.starts_with(&at)).find(|m| {
        let exports = format!("pub use {}::", m.last().expect("longer than its parent"));
        codes[&at].match_indices(&exports).any(|(i, _)| {
            let list = &codes[&at][i..];
            let list = &list[..list.find(';').unwrap_or(list.len())];
            list.split(|c: char| !c.is_alphanumeric() && c != '_').any(|word| word == name)
        })
    });
    child.cloned().or(Some(at))
}

#[test]
fn groups_are_expanded_and_generics_end_a_path() {
    let code = "use crate::{a, b::{c, d as e}, f::g};\nlet x = super::h::k::<u8>(); use super::super::m::N;";
    let found: Vec<String> = paths(code).iter().map(|p| p.join("::")).collect();
    assert_eq!(found, ["crate::a", "crate::b::c", "crate::b::d", "crate::f::g", "super::h::k", "super::super::m::N"]);
}

#[test]
fn circles_are_found_through_re_exports_and_not_between_parent_and_child() {
    let file = |path: &str, text: &str| File { path: path.into(), text: text.into() };
    let all = [
        file("src/lib.rs", "mod a; mod b; pub mod c;"),
        file("src/a.rs", "use crate::c::One;"),
        file("src/b.rs", "use crate::a::X; use crate::c;"),
        file("src/c/mod.rs", "mod one; mod two; pub use one::One; use two::Two;"),
        file("src/c/one.rs", "use super::two::Two;"),
        file("src/c/two.rs", "use super::{other, One};"),
    ];
    assert_eq!(Graph::of("src/", &all).circles(), ["c::one and c::two see each other, directly or through others"]);
}

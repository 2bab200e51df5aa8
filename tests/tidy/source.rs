//! The project's files as text, and Rust source with comments, strings and tests blanked.

use std::path::{Path, PathBuf};

pub struct File {
    /// From the root of the repository, with forward slashes.
    pub path: String,
    pub text: String,
}

impl File {
    pub fn ends_with(&self, extension: &str) -> bool {
        self.path.ends_with(extension)
    }

    pub fn below(&self, folders: &[&str]) -> bool {
        folders.iter().any(|f| self.path.starts_with(f))
    }
}

/// Every text file of the project.
pub fn files() -> Vec<File> {
    // Asked at run time, so that one build of this test can look at another checkout.
    let root = std::env::var("CARGO_MANIFEST_DIR").expect("cargo sets it");
    let root = Path::new(&root);
    let mut found = Vec::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path: PathBuf = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            let skipped = ["target", "out", ".git", ".gl", ".carry", "shared", "proptest-regressions"];
            if skipped.contains(&name.as_str()) {
                continue;
            }
            if path.is_dir() {
                folders.push(path);
            } else if let Ok(text) = std::fs::read_to_string(&path) {
                let relative = path.strip_prefix(root).unwrap().to_string_lossy().replace('\\', "/");
                found.push(File { path: relative, text });
            }
        }
    }
    found.sort_by(|a, b| a.path.cmp(&b.path));
    assert!(found.iter().any(|f| f.path == "src/lib.rs"), "the walk finds the sources");
    found
}

/// Source text with comments and the insides of strings blanked, line by line as it was.
pub fn code(text: &str) -> String {
    let bytes = text.as_bytes();
    let mut out = bytes.to_vec();
    let mut i = 0;
    while i < bytes.len() {
        let end = token_end(bytes, i);
        if end > i {
            out[i..end].iter_mut().filter(|b| **b != b'\n').for_each(|b| *b = b' ');
            i = end;
        } else {
            i += 1;
        }
    }
    String::from_utf8_lossy(&out).into_owned()
}

/// Where the comment, string or character that starts at `i` ends; `i` when none starts there.
pub fn token_end(bytes: &[u8], i: usize) -> usize {
    let rest = &bytes[i..];
    let until = |from: usize, close: &[u8]| {
        let found = rest[from..].windows(close.len()).position(|w| w == close);
        found.map_or(bytes.len(), |at| i + from + at + close.len())
    };
    let in_word = i > 0 && (bytes[i - 1].is_ascii_alphanumeric() || bytes[i - 1] == b'_');
    match rest {
        [b'/', b'/', ..] => until(2, b"\n") - 1,
        [b'/', b'*', ..] => until(2, b"*/"),
        [b'r', b'"', ..] if !in_word => until(2, b"\""),
        [b'r', b'#', ..] if !in_word && rest[1..].iter().find(|b| **b != b'#') == Some(&b'"') => {
            let hashes = rest[1..].iter().take_while(|b| **b == b'#').count();
            let close: Vec<u8> = std::iter::once(b'"').chain(std::iter::repeat_n(b'#', hashes)).collect();
            until(hashes + 2, &close)
        }
        [b'"', ..] => quoted_end(bytes, i),
        // A character, not a lifetime.
        [b'\'', b'\\', _, ..] => until(3, b"'"),
        [b'\'', first, ..] => {
            let width = if *first < 0x80 { 1 } else { first.leading_ones() as usize };
            if rest.get(1 + width) == Some(&b'\'') {
                i + 2 + width
            } else {
                i
            }
        }
        _ => i,
    }
}

pub fn quoted_end(bytes: &[u8], start: usize) -> usize {
    let mut i = start + 1;
    while i < bytes.len() && bytes[i] != b'"' {
        i += if bytes[i] == b'\\' { 2 } else { 1 };
    }
    (i + 1).min(bytes.len())
}

/// Code with everything under `#[cfg(test)]` blanked too.
pub fn shipped_code(text: &str) -> String {
    let mut code = code(text);
    while let Some(start) = code.find("#[cfg(test)]") {
        let rest = &code[start..];
        let semicolon = rest.find(';').unwrap_or(rest.len());
        let end = match rest.find('{') {
            Some(open) if open < semicolon => closing(rest, open),
            _ => (semicolon + 1).min(rest.len()),
        };
        let blank: String = rest[..end].chars().map(|c| if c == '\n' { '\n' } else { ' ' }).collect();
        code.replace_range(start..start + end, &blank);
    }
    code
}

/// After the brace that closes the one at `open`.
pub fn closing(code: &str, open: usize) -> usize {
    let mut depth = 0;
    for (i, c) in code[open..].char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return open + i + 1;
        }
    }
    code.len()
}

/// Files that hold only tests: named by `#[cfg(test)] mod name;` beside them, or saying so themselves.
pub fn is_test_file(file: &File, all: &[File]) -> bool {
    let Some((folder, name)) = file.path.rsplit_once('/') else { return false };
    let declared = format!("mod {};", name.trim_end_matches(".rs"));
    let parents = [format!("{folder}/mod.rs"), format!("{folder}/lib.rs"), format!("{folder}.rs")];
    let declares = |f: &&File| f.path != file.path && parents.contains(&f.path);
    let hidden = |f: &File| code(&f.text).contains(&declared) && !shipped_code(&f.text).contains(&declared);
    file.text.contains("#![cfg(test)]") || all.iter().filter(declares).any(hidden)
}

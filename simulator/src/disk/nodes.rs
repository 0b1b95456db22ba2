// SPDX-License-Identifier: MIT OR Apache-2.0
//! Numbers for files: the kernel's names for what lies below the backing directory.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// The inode number of the root directory.
pub const ROOT: u64 = 1;

/// Which number is which path; a number is never used again, so that the kernel cannot take one file for another.
#[derive(Debug)]
pub struct Nodes {
    paths: HashMap<u64, PathBuf>,
    numbers: HashMap<PathBuf, u64>,
    next: u64,
}

impl Nodes {
    /// A table that has the root directory only.
    pub fn new() -> Self {
        let paths = HashMap::from([(ROOT, PathBuf::new())]);
        let numbers = HashMap::from([(PathBuf::new(), ROOT)]);
        Self { paths, numbers, next: ROOT + 1 }
    }

    /// The path below the root.
    pub fn path(&self, number: u64) -> Option<&Path> {
        self.paths.get(&number).map(PathBuf::as_path)
    }

    /// The number of this path, a new one if it has none.
    pub fn number(&mut self, path: &Path) -> u64 {
        if let Some(number) = self.numbers.get(path) {
            return *number;
        }
        let number = self.next;
        self.next += 1;
        self.paths.insert(number, path.to_owned());
        self.numbers.insert(path.to_owned(), number);
        number
    }

    /// The path is no more; returns the number that it had.
    pub fn remove(&mut self, path: &Path) -> Option<u64> {
        let number = self.numbers.remove(path)?;
        self.paths.remove(&number);
        Some(number)
    }

    /// The path, and everything below it, has a new name; returns the number of what had that name before.
    pub fn rename(&mut self, from: &Path, to: &Path) -> Option<u64> {
        let replaced = self.remove(to);
        let moved: Vec<(PathBuf, u64)> = self
            .numbers
            .iter()
            .filter(|(path, _)| path.starts_with(from))
            .map(|(path, number)| (path.clone(), *number))
            .collect();
        for (path, number) in moved {
            self.numbers.remove(&path);
            let new = path.strip_prefix(from).map_or_else(|_| to.to_owned(), |rest| join(to, rest));
            self.numbers.insert(new.clone(), number);
            self.paths.insert(number, new);
        }
        replaced
    }
}

/// Without the trailing slash that an empty rest would leave.
fn join(base: &Path, rest: &Path) -> PathBuf {
    if rest.as_os_str().is_empty() { base.to_owned() } else { base.join(rest) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_follow_names_and_are_never_used_again() {
        let mut nodes = Nodes::new();
        let (dir, file) = (nodes.number(Path::new("s")), nodes.number(Path::new("s/a.next")));
        assert_eq!(nodes.number(Path::new("s")), dir);
        assert_eq!(nodes.rename(Path::new("s/a.next"), Path::new("s/a")), None);
        assert_eq!(nodes.path(file), Some(Path::new("s/a")));
        nodes.rename(Path::new("s"), Path::new("t"));
        assert_eq!((nodes.path(file), nodes.path(dir)), (Some(Path::new("t/a")), Some(Path::new("t"))));
        assert_eq!(nodes.remove(Path::new("t/a")), Some(file));
        assert_eq!(nodes.path(file), None);
        assert!(nodes.number(Path::new("t/a")) > file);
        let other = nodes.number(Path::new("t/b"));
        assert_eq!(nodes.rename(Path::new("t/a"), Path::new("t/b")), Some(other));
    }
}

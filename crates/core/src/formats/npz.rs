// SPDX-License-Identifier: MIT OR Apache-2.0
//! NumPy's `npz`: named arrays in a zip file. Ground truth and maps for comparison are kept so, readable by everybody.

use crate::base::regular;
use npyz::{AutoSerialize, Deserialize, NpyFile, WriteOptions, WriterBuilder};
use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Write};
use std::path::Path;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipArchive, ZipWriter};

/// No array that is kept so has more, bytes.
const ARRAY_BYTES_MAX: u64 = 1 << 30;

/// An `npz` that is read.
pub struct NpzReader(ZipArchive<BufReader<File>>);

impl NpzReader {
    /// Opens a file and reads its list of arrays.
    pub fn open(path: &Path) -> io::Result<Self> {
        Ok(Self(ZipArchive::new(BufReader::new(regular::open(path)?))?))
    }

    /// The names of its arrays.
    pub fn names(&self) -> Vec<String> {
        let array = |name: &str| name.strip_suffix(".npy").map(str::to_owned);
        self.0.file_names().filter_map(|name| array(&name.ok()?)).collect()
    }

    /// An array's shape and its numbers, row by row.
    pub fn array<T: Deserialize>(&mut self, name: &str) -> Result<(Vec<u64>, Vec<T>), String> {
        let file = self.0.by_name(&format!("{name}.npy"));
        let file = file.map_err(|e| format!("there is no readable array {name:?}: {e}"))?;
        let unpacked = file.size();
        if unpacked > ARRAY_BYTES_MAX {
            return Err(format!("{name}: expected at most {ARRAY_BYTES_MAX} bytes, found {unpacked}"));
        }
        let array = NpyFile::new(file.take(unpacked)).map_err(|e| format!("{name}: {e}"))?;
        let shape = array.shape().to_vec();
        // Memory is taken for what is announced.
        let numbers = shape.iter().try_fold(1u64, |all, side| all.checked_mul(*side));
        if numbers.is_none_or(|numbers| numbers > unpacked) {
            return Err(format!("{name}: expected the numbers of {shape:?} in {unpacked} bytes"));
        }
        let by_columns = array.order() == npyz::Order::Fortran && shape.len() > 1;
        let numbers: Vec<T> = array.into_vec().map_err(|e| format!("{name}: {e}"))?;
        let (true, [rows, _]) = (by_columns, &shape[..]) else {
            let said =
                format!("{name}: expected rows first, found columns; write numpy.ascontiguousarray of it");
            return if by_columns { Err(said) } else { Ok((shape, numbers)) };
        };
        let rows = *rows as usize;
        let mut numbers: Vec<(usize, T)> = numbers.into_iter().enumerate().collect();
        numbers.sort_by_key(|(i, _)| (i % rows, i / rows));
        let numbers = numbers.into_iter().map(|number| number.1).collect();
        Ok((shape, numbers))
    }
}

/// An `npz` that is written.
pub struct NpzWriter(ZipWriter<BufWriter<File>>);

impl NpzWriter {
    /// Begins a file without any array.
    pub fn create(path: &Path) -> io::Result<Self> {
        Ok(Self(ZipWriter::new(BufWriter::new(File::create(path)?))))
    }

    /// Adds an array, which the compressor gets in one piece: number by number would take a hundred times longer.
    pub fn add<T: AutoSerialize + Copy>(
        &mut self,
        name: &str,
        shape: &[u64],
        numbers: &[T],
    ) -> io::Result<()> {
        let mut bytes = Vec::with_capacity(std::mem::size_of_val(numbers) + 128);
        let mut array = WriteOptions::new().default_dtype().shape(shape).writer(&mut bytes).begin_nd()?;
        array.extend(numbers.iter().copied())?;
        array.finish()?;
        // Without a time of writing the same arrays have the same bytes.
        let options = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Deflated)
            .compression_level(Some(1))
            .last_modified_time(DateTime::default());
        self.0.start_file(format!("{name}.npy"), options)?;
        self.0.write_all(&bytes)
    }

    /// Writes the file's list of arrays, and ends it.
    pub fn finish(self) -> io::Result<()> {
        self.0.finish()?.flush()
    }
}

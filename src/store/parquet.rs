//! The stations of every result as one Parquet table, a row group for so many inspections: memory does not grow with their number.

use std::io::Write;
use std::sync::Arc;

use parquet::basic::Compression;
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, DoubleType, Int64Type};
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::parser::parse_message_type;

use super::export::{ExportError, parsed};
use super::inspections::status_word;
use super::{History, Store};
use crate::report::Report;

/// Rows that make a row group.
const ROWS: usize = 100_000;

const SCHEMA: &str = "message station {
    required int64 inspection;
    required binary part_serial (STRING);
    required binary ended (STRING);
    required boolean simulated;
    required binary edge (STRING);
    required double s_mm;
    required double nominal_x_mm;
    required double nominal_y_mm;
    required double nominal_z_mm;
    optional double d1_mm;
    optional double u_d1_mm;
    optional double d2_mm;
    optional double u_d2_mm;
    optional double included_angle_deg;
    optional double u_included_angle_deg;
    required int64 points_1;
    required int64 points_2;
    required binary status (STRING);
    required binary reason (STRING);
}";

/// The columns of one row group, in the order of the schema.
#[derive(Default)]
struct Rows {
    inspection: Vec<i64>,
    part_serial: Vec<ByteArray>,
    ended: Vec<ByteArray>,
    simulated: Vec<bool>,
    edge: Vec<ByteArray>,
    places: [Vec<f64>; 4],
    values: [Vec<Option<f64>>; 6],
    points: [Vec<i64>; 2],
    status: Vec<ByteArray>,
    reason: Vec<ByteArray>,
}

impl Store {
    /// See [`Store::export`].
    pub(super) fn export_parquet(
        &self,
        history: &History,
        out: &mut (dyn Write + Send),
    ) -> Result<u64, ExportError> {
        let schema = Arc::new(parse_message_type(SCHEMA)?);
        let properties = WriterProperties::builder().set_compression(Compression::SNAPPY);
        let mut file = SerializedFileWriter::new(out, schema, Arc::new(properties.build()))?;
        let mut rows = Rows::default();
        let written = self.each_report(history, &mut |inspection, json| {
            rows.add(inspection, &parsed(inspection, json)?);
            if rows.inspection.len() >= ROWS {
                std::mem::take(&mut rows).write(&mut file)?;
            }
            Ok(())
        })?;
        rows.write(&mut file)?;
        file.close()?;
        Ok(written)
    }
}

impl Rows {
    fn add(&mut self, inspection: &super::Inspection, report: &Report) {
        let text = |text: &str| ByteArray::from(text.as_bytes().to_vec());
        for edge in &report.edges {
            for station in &edge.stations {
                self.inspection.push(inspection.id);
                self.part_serial.push(text(&inspection.part_serial));
                self.ended
                    .push(text(inspection.ended.as_deref().unwrap_or_default()));
                self.simulated.push(inspection.simulated);
                self.edge.push(text(&edge.id));
                let [x, y, z] = station.nominal;
                for (column, value) in self.places.iter_mut().zip([station.s_mm, x, y, z]) {
                    column.push(value);
                }
                let values = [
                    station.d1_mm,
                    station.u_d1_mm,
                    station.d2_mm,
                    station.u_d2_mm,
                    station.included_angle_deg,
                    station.u_included_angle_deg,
                ];
                for (column, value) in self.values.iter_mut().zip(values) {
                    column.push(value);
                }
                self.points[0].push(station.points_1 as i64);
                self.points[1].push(station.points_2 as i64);
                self.status.push(text(status_word(station.status)));
                self.reason.push(text(&station.reason));
            }
        }
    }

    fn write<W: Write + Send>(self, file: &mut SerializedFileWriter<W>) -> Result<(), ExportError> {
        if self.inspection.is_empty() {
            return Ok(());
        }
        let mut group = file.next_row_group()?;
        column::<Int64Type, W>(&mut group, &self.inspection, None)?;
        column::<ByteArrayType, W>(&mut group, &self.part_serial, None)?;
        column::<ByteArrayType, W>(&mut group, &self.ended, None)?;
        column::<BoolType, W>(&mut group, &self.simulated, None)?;
        column::<ByteArrayType, W>(&mut group, &self.edge, None)?;
        for place in &self.places {
            column::<DoubleType, W>(&mut group, place, None)?;
        }
        for values in &self.values {
            // A value that is not there has level 0 and no place in the column.
            let levels: Vec<i16> = values
                .iter()
                .map(|value| i16::from(value.is_some()))
                .collect();
            let there: Vec<f64> = values.iter().copied().flatten().collect();
            column::<DoubleType, W>(&mut group, &there, Some(&levels))?;
        }
        for points in &self.points {
            column::<Int64Type, W>(&mut group, points, None)?;
        }
        column::<ByteArrayType, W>(&mut group, &self.status, None)?;
        column::<ByteArrayType, W>(&mut group, &self.reason, None)?;
        group.close()?;
        Ok(())
    }
}

fn column<T: DataType, W: Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    values: &[T::T],
    levels: Option<&[i16]>,
) -> Result<(), ExportError> {
    if let Some(mut column) = group.next_column()? {
        column.typed::<T>().write_batch(values, levels, None)?;
        column.close()?;
    }
    Ok(())
}

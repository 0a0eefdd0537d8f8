"""Files in and out: tables, CSV, units, records, and writing what is whole or not at all."""

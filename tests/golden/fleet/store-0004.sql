-- A store as migrations 0001 to 0004 made it before they became one: machine, two measurements, two versions.
PRAGMA user_version = 1084294993;
BEGIN TRANSACTION;
CREATE TABLE alembic_version (
	version_num VARCHAR(32) NOT NULL,
	CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num)
);
INSERT INTO "alembic_version" VALUES('0004');
CREATE TABLE attempts (
	id INTEGER NOT NULL,
	machine_id INTEGER NOT NULL,
	measurement_id INTEGER NOT NULL,
	outcome TEXT NOT NULL,
	message TEXT NOT NULL,
	settings_sha256 VARCHAR(64) NOT NULL,
	owner TEXT NOT NULL,
	seconds FLOAT NOT NULL,
	at DATETIME NOT NULL,
	PRIMARY KEY (id),
	FOREIGN KEY(machine_id) REFERENCES machines (id),
	FOREIGN KEY(measurement_id) REFERENCES measurements (id)
);
CREATE TABLE blobs (
	sha256 VARCHAR(64) NOT NULL,
	size BIGINT NOT NULL,
	deflated BLOB NOT NULL,
	PRIMARY KEY (sha256)
);
INSERT INTO "blobs" VALUES('0000000000000000000000000000000000000000000000000000000000000000',0,X'00');
CREATE TABLE claims (
	id INTEGER NOT NULL,
	measurement_id INTEGER NOT NULL,
	sequence INTEGER NOT NULL,
	kind TEXT NOT NULL,
	owner TEXT NOT NULL,
	at DATETIME NOT NULL,
	until DATETIME NOT NULL,
	PRIMARY KEY (id),
	FOREIGN KEY(measurement_id) REFERENCES measurements (id),
	UNIQUE (measurement_id, sequence)
);
CREATE TABLE decisions (
	id INTEGER NOT NULL,
	machine_id INTEGER NOT NULL,
	sequence INTEGER NOT NULL,
	table_id INTEGER,
	kind TEXT NOT NULL,
	actor TEXT NOT NULL,
	reason TEXT NOT NULL,
	at DATETIME NOT NULL,
	PRIMARY KEY (id),
	FOREIGN KEY(machine_id) REFERENCES machines (id),
	FOREIGN KEY(table_id) REFERENCES tables (id),
	UNIQUE (machine_id, sequence)
);
INSERT INTO "decisions" VALUES(1,1,1,3,'approve','ada','why','2025-01-01 00:00:00');
CREATE TABLE events (
	id INTEGER NOT NULL,
	machine_id INTEGER,
	kind TEXT NOT NULL,
	subject TEXT NOT NULL,
	message TEXT NOT NULL,
	at DATETIME NOT NULL,
	PRIMARY KEY (id),
	FOREIGN KEY(machine_id) REFERENCES machines (id)
);
CREATE TABLE identifications (
    id INTEGER NOT NULL,
    machine_id INTEGER NOT NULL,
    measurement_id INTEGER NOT NULL,
    machine_version_id INTEGER NOT NULL,
    active_table_id INTEGER,
    errors_sha256 VARCHAR(64) NOT NULL,
    covariance_sha256 VARCHAR(64),
    fitted_sha256 VARCHAR(64),
    summary JSON NOT NULL,
    program TEXT NOT NULL,
    at DATETIME NOT NULL,
    revision INTEGER DEFAULT 1 NOT NULL,
    FOREIGN KEY(covariance_sha256) REFERENCES blobs (sha256),
    FOREIGN KEY(errors_sha256) REFERENCES blobs (sha256),
    FOREIGN KEY(fitted_sha256) REFERENCES blobs (sha256),
    FOREIGN KEY(machine_id) REFERENCES machines (id),
    FOREIGN KEY(machine_version_id) REFERENCES machine_versions (id),
    FOREIGN KEY(measurement_id) REFERENCES measurements (id),
    PRIMARY KEY (id),
    UNIQUE (measurement_id, revision)
);
INSERT INTO "identifications" VALUES(7,1,2,1,NULL,'0000000000000000000000000000000000000000000000000000000000000000',NULL,NULL,'{}','p','2025-01-01 00:00:00',1);
INSERT INTO "identifications" VALUES(9,1,1,1,3,'0000000000000000000000000000000000000000000000000000000000000000',NULL,'0000000000000000000000000000000000000000000000000000000000000000','{"rms": 0.5}','p','2025-01-01 00:00:00',1);
CREATE TABLE machine_versions (
	id INTEGER NOT NULL,
	machine_id INTEGER NOT NULL,
	sha256 VARCHAR(64) NOT NULL,
	at DATETIME NOT NULL,
	PRIMARY KEY (id),
	FOREIGN KEY(machine_id) REFERENCES machines (id),
	FOREIGN KEY(sha256) REFERENCES blobs (sha256),
	UNIQUE (machine_id, sha256)
);
INSERT INTO "machine_versions" VALUES(1,1,'0000000000000000000000000000000000000000000000000000000000000000','2025-01-01 00:00:00');
CREATE TABLE machines (
	id INTEGER NOT NULL,
	name VARCHAR(200) NOT NULL,
	at DATETIME NOT NULL,
	PRIMARY KEY (id),
	UNIQUE (name)
);
INSERT INTO "machines" VALUES(1,'old','2025-01-01 00:00:00');
CREATE TABLE measurement_files (
	id INTEGER NOT NULL,
	measurement_id INTEGER NOT NULL,
	name TEXT NOT NULL,
	sha256 VARCHAR(64) NOT NULL,
	PRIMARY KEY (id),
	FOREIGN KEY(measurement_id) REFERENCES measurements (id),
	FOREIGN KEY(sha256) REFERENCES blobs (sha256)
);
CREATE TABLE measurements (
	id INTEGER NOT NULL,
	machine_id INTEGER NOT NULL,
	sha256 VARCHAR(64) NOT NULL,
	name TEXT NOT NULL,
	measured_at DATETIME NOT NULL,
	measured_at_source TEXT NOT NULL,
	received_at DATETIME NOT NULL,
	active_table TEXT,
	temperatures_c JSON NOT NULL,
	PRIMARY KEY (id),
	FOREIGN KEY(machine_id) REFERENCES machines (id),
	UNIQUE (machine_id, sha256)
);
INSERT INTO "measurements" VALUES(1,1,'0000000000000000000000000000000000000000000000000000000000000000','m','2025-01-01 00:00:00','file','2025-01-01 00:00:00',NULL,'{"temp_x_c": {"mean": 20.5}}');
INSERT INTO "measurements" VALUES(2,1,'b','n','2025-01-01 00:00:00','file','2025-01-01 00:00:00',NULL,'{}');
CREATE TABLE table_files (
	id INTEGER NOT NULL,
	table_id INTEGER NOT NULL,
	controller TEXT NOT NULL,
	name TEXT NOT NULL,
	sha256 VARCHAR(64) NOT NULL,
	PRIMARY KEY (id),
	FOREIGN KEY(sha256) REFERENCES blobs (sha256),
	FOREIGN KEY(table_id) REFERENCES tables (id)
);
CREATE TABLE tables (
	id INTEGER NOT NULL,
	machine_id INTEGER NOT NULL,
	version INTEGER NOT NULL,
	identification_id INTEGER NOT NULL,
	accepted BOOLEAN NOT NULL,
	controllers JSON NOT NULL,
	reasons JSON NOT NULL,
	summary JSON NOT NULL,
	at DATETIME NOT NULL,
	PRIMARY KEY (id),
	FOREIGN KEY(identification_id) REFERENCES identifications (id),
	FOREIGN KEY(machine_id) REFERENCES machines (id),
	UNIQUE (machine_id, version)
);
INSERT INTO "tables" VALUES(3,1,1,7,1,'["isg-csv"]','[]','{}','2025-01-01 00:00:00');
INSERT INTO "tables" VALUES(4,1,2,9,1,'["isg-csv"]','[]','{}','2025-01-01 00:00:00');
CREATE INDEX ix_events_machine_id ON events (machine_id);
CREATE INDEX ix_machine_versions_machine_id ON machine_versions (machine_id);
CREATE INDEX ix_measurements_machine_id ON measurements (machine_id);
CREATE INDEX ix_attempts_machine_id ON attempts (machine_id);
CREATE INDEX ix_attempts_measurement_id ON attempts (measurement_id);
CREATE INDEX ix_claims_measurement_id ON claims (measurement_id);
CREATE INDEX ix_measurement_files_measurement_id ON measurement_files (measurement_id);
CREATE INDEX ix_tables_identification_id ON tables (identification_id);
CREATE INDEX ix_tables_machine_id ON tables (machine_id);
CREATE INDEX ix_decisions_machine_id ON decisions (machine_id);
CREATE INDEX ix_decisions_table_id ON decisions (table_id);
CREATE INDEX ix_table_files_table_id ON table_files (table_id);
CREATE TRIGGER append_only_blobs_update BEFORE UPDATE ON blobs BEGIN SELECT RAISE(ABORT, 'append-only: blobs takes new rows only'); END;
CREATE TRIGGER append_only_blobs_delete BEFORE DELETE ON blobs BEGIN SELECT RAISE(ABORT, 'append-only: blobs takes new rows only'); END;
CREATE TRIGGER append_only_machines_update BEFORE UPDATE ON machines BEGIN SELECT RAISE(ABORT, 'append-only: machines takes new rows only'); END;
CREATE TRIGGER append_only_machines_delete BEFORE DELETE ON machines BEGIN SELECT RAISE(ABORT, 'append-only: machines takes new rows only'); END;
CREATE TRIGGER append_only_machine_versions_update BEFORE UPDATE ON machine_versions BEGIN SELECT RAISE(ABORT, 'append-only: machine_versions takes new rows only'); END;
CREATE TRIGGER append_only_machine_versions_delete BEFORE DELETE ON machine_versions BEGIN SELECT RAISE(ABORT, 'append-only: machine_versions takes new rows only'); END;
CREATE TRIGGER append_only_measurements_update BEFORE UPDATE ON measurements BEGIN SELECT RAISE(ABORT, 'append-only: measurements takes new rows only'); END;
CREATE TRIGGER append_only_measurements_delete BEFORE DELETE ON measurements BEGIN SELECT RAISE(ABORT, 'append-only: measurements takes new rows only'); END;
CREATE TRIGGER append_only_measurement_files_update BEFORE UPDATE ON measurement_files BEGIN SELECT RAISE(ABORT, 'append-only: measurement_files takes new rows only'); END;
CREATE TRIGGER append_only_measurement_files_delete BEFORE DELETE ON measurement_files BEGIN SELECT RAISE(ABORT, 'append-only: measurement_files takes new rows only'); END;
CREATE TRIGGER append_only_claims_update BEFORE UPDATE ON claims BEGIN SELECT RAISE(ABORT, 'append-only: claims takes new rows only'); END;
CREATE TRIGGER append_only_claims_delete BEFORE DELETE ON claims BEGIN SELECT RAISE(ABORT, 'append-only: claims takes new rows only'); END;
CREATE TRIGGER append_only_attempts_update BEFORE UPDATE ON attempts BEGIN SELECT RAISE(ABORT, 'append-only: attempts takes new rows only'); END;
CREATE TRIGGER append_only_attempts_delete BEFORE DELETE ON attempts BEGIN SELECT RAISE(ABORT, 'append-only: attempts takes new rows only'); END;
CREATE TRIGGER append_only_tables_update BEFORE UPDATE ON tables BEGIN SELECT RAISE(ABORT, 'append-only: tables takes new rows only'); END;
CREATE TRIGGER append_only_tables_delete BEFORE DELETE ON tables BEGIN SELECT RAISE(ABORT, 'append-only: tables takes new rows only'); END;
CREATE TRIGGER append_only_table_files_update BEFORE UPDATE ON table_files BEGIN SELECT RAISE(ABORT, 'append-only: table_files takes new rows only'); END;
CREATE TRIGGER append_only_table_files_delete BEFORE DELETE ON table_files BEGIN SELECT RAISE(ABORT, 'append-only: table_files takes new rows only'); END;
CREATE TRIGGER append_only_decisions_update BEFORE UPDATE ON decisions BEGIN SELECT RAISE(ABORT, 'append-only: decisions takes new rows only'); END;
CREATE TRIGGER append_only_decisions_delete BEFORE DELETE ON decisions BEGIN SELECT RAISE(ABORT, 'append-only: decisions takes new rows only'); END;
CREATE TRIGGER append_only_events_update BEFORE UPDATE ON events BEGIN SELECT RAISE(ABORT, 'append-only: events takes new rows only'); END;
CREATE TRIGGER append_only_events_delete BEFORE DELETE ON events BEGIN SELECT RAISE(ABORT, 'append-only: events takes new rows only'); END;
CREATE INDEX ix_identifications_machine_id ON identifications (machine_id);
CREATE INDEX ix_identifications_machine_version_id ON identifications (machine_version_id);
CREATE INDEX ix_identifications_measurement_id ON identifications (measurement_id);
CREATE TRIGGER append_only_identifications_update BEFORE UPDATE ON identifications BEGIN SELECT RAISE(ABORT, 'append-only: identifications takes new rows only'); END;
CREATE TRIGGER append_only_identifications_delete BEFORE DELETE ON identifications BEGIN SELECT RAISE(ABORT, 'append-only: identifications takes new rows only'); END;
CREATE TRIGGER append_only_blobs_replace BEFORE INSERT ON blobs WHEN EXISTS (SELECT 1 FROM blobs WHERE sha256 = NEW.sha256) BEGIN SELECT RAISE(ABORT, 'append-only: blobs takes new rows only'); END;
CREATE TRIGGER append_only_machines_replace BEFORE INSERT ON machines WHEN EXISTS (SELECT 1 FROM machines WHERE name = NEW.name) OR EXISTS (SELECT 1 FROM machines WHERE id = NEW.id) BEGIN SELECT RAISE(ABORT, 'append-only: machines takes new rows only'); END;
CREATE TRIGGER append_only_machine_versions_replace BEFORE INSERT ON machine_versions WHEN EXISTS (SELECT 1 FROM machine_versions WHERE machine_id = NEW.machine_id AND sha256 = NEW.sha256) OR EXISTS (SELECT 1 FROM machine_versions WHERE id = NEW.id) BEGIN SELECT RAISE(ABORT, 'append-only: machine_versions takes new rows only'); END;
CREATE TRIGGER append_only_measurements_replace BEFORE INSERT ON measurements WHEN EXISTS (SELECT 1 FROM measurements WHERE machine_id = NEW.machine_id AND sha256 = NEW.sha256) OR EXISTS (SELECT 1 FROM measurements WHERE id = NEW.id) BEGIN SELECT RAISE(ABORT, 'append-only: measurements takes new rows only'); END;
CREATE TRIGGER append_only_measurement_files_replace BEFORE INSERT ON measurement_files WHEN EXISTS (SELECT 1 FROM measurement_files WHERE id = NEW.id) BEGIN SELECT RAISE(ABORT, 'append-only: measurement_files takes new rows only'); END;
CREATE TRIGGER append_only_claims_replace BEFORE INSERT ON claims WHEN EXISTS (SELECT 1 FROM claims WHERE measurement_id = NEW.measurement_id AND sequence = NEW.sequence) OR EXISTS (SELECT 1 FROM claims WHERE id = NEW.id) BEGIN SELECT RAISE(ABORT, 'append-only: claims takes new rows only'); END;
CREATE TRIGGER append_only_attempts_replace BEFORE INSERT ON attempts WHEN EXISTS (SELECT 1 FROM attempts WHERE id = NEW.id) BEGIN SELECT RAISE(ABORT, 'append-only: attempts takes new rows only'); END;
CREATE TRIGGER append_only_identifications_replace BEFORE INSERT ON identifications WHEN EXISTS (SELECT 1 FROM identifications WHERE measurement_id = NEW.measurement_id AND revision = NEW.revision) OR EXISTS (SELECT 1 FROM identifications WHERE id = NEW.id) BEGIN SELECT RAISE(ABORT, 'append-only: identifications takes new rows only'); END;
CREATE TRIGGER append_only_tables_replace BEFORE INSERT ON tables WHEN EXISTS (SELECT 1 FROM tables WHERE machine_id = NEW.machine_id AND version = NEW.version) OR EXISTS (SELECT 1 FROM tables WHERE id = NEW.id) BEGIN SELECT RAISE(ABORT, 'append-only: tables takes new rows only'); END;
CREATE TRIGGER append_only_table_files_replace BEFORE INSERT ON table_files WHEN EXISTS (SELECT 1 FROM table_files WHERE id = NEW.id) BEGIN SELECT RAISE(ABORT, 'append-only: table_files takes new rows only'); END;
CREATE TRIGGER append_only_decisions_replace BEFORE INSERT ON decisions WHEN EXISTS (SELECT 1 FROM decisions WHERE machine_id = NEW.machine_id AND sequence = NEW.sequence) OR EXISTS (SELECT 1 FROM decisions WHERE id = NEW.id) BEGIN SELECT RAISE(ABORT, 'append-only: decisions takes new rows only'); END;
CREATE TRIGGER append_only_events_replace BEFORE INSERT ON events WHEN EXISTS (SELECT 1 FROM events WHERE id = NEW.id) BEGIN SELECT RAISE(ABORT, 'append-only: events takes new rows only'); END;
COMMIT;

"""Apache Airflow: one task per machine of a job file. Exit code 1 of `volcomp recal run` asks for a person.

For Airflow 2.6 and later; in Airflow 3 the operator is imported from airflow.providers.standard.operators.bash.
Put this file into the folder of the DAGs; COMPGEN and JOB are paths on the worker.
"""

from datetime import datetime, timedelta
from pathlib import Path

from airflow import DAG
from airflow.operators.bash import BashOperator

COMPGEN = "/opt/compgen/bin/compgen"
JOB = "/etc/compgen/recal.toml"
#: A list in the file, not read from the job file: a DAG should look the same at every parse.
MACHINES = ("mill-1", "mill-2")

with DAG(
    dag_id="compgen_recal",
    description="machine-tool recalibration",
    schedule="30 6 * * 1-5",
    start_date=datetime(2026, 1, 1),
    catchup=False,
    max_active_runs=1,
    # the store keeps two runners apart and a run may be repeated at will, so retries are safe
    default_args={"retries": 2, "retry_delay": timedelta(minutes=10)},
) as dag:
    for name in MACHINES:
        # `skip_on_exit_code` ends the task as skipped, without a retry: held back is for people, not for a second try
        BashOperator(
            task_id=f"recal_{name}",
            bash_command=f"{COMPGEN} recal run {name} --job {JOB} --log json",
            skip_on_exit_code=1,
            cwd=str(Path(JOB).parent),
        )

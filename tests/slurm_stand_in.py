"""A mock of the Slurm commands that submitit uses; the jobs of an array run immediately on this machine."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path

ARRAY = 4200  # the array's number
# Starts the script for every task of the array, as Slurm would on a node, and returns at once.
SBATCH = f"""
    import os, pathlib, re, subprocess, sys

    script = sys.argv[-1]
    first, last = map(int, re.search(r"^#SBATCH --array=(\\d+)-(\\d+)%", open(script).read(), re.MULTILINE).groups())
    for task in range(first, last + 1):
        job = {{"JOB_ID": {ARRAY} + 1 + task, "ARRAY_JOB_ID": {ARRAY}, "ARRAY_TASK_ID": task, "JOB_NAME": "eval"}}
        place = {{"NTASKS": 1, "JOB_NUM_NODES": 1, "NNODES": 1, "NODEID": 0, "PROCID": 0, "LOCALID": 0}}
        slurm = {{f"SLURM_{{key}}": str(value) for key, value in (job | place).items()}}
        environment = os.environ | slurm | {{"SLURM_JOB_NODELIST": "node0", "SLURMD_NODENAME": "node0"}}
        printed = pathlib.Path(__file__).with_name(f"job_{{task}}.txt")
        ran = subprocess.Popen(["bash", script], env=environment, stdout=printed.open("w"), stderr=subprocess.STDOUT)
        printed.with_suffix(".pid").write_text(str(ran.pid))
    print("Submitted batch job {ARRAY}")
"""
SRUN = """
    import os, sys

    command = sys.argv[1:]
    while command[0].startswith("-"):
        command = command[2 if command[0] in ("--output", "--error") else 1 :]
    os.execvp(command[0], command)
"""
# A job that has died is not waited for.
SACCT = f"""
    import os, pathlib

    print("JobID|State|NodeList")
    for file in pathlib.Path(__file__).parent.glob("job_*.pid"):
        try:
            os.kill(int(file.read_text()), 0)
            state = "RUNNING"
        except ProcessLookupError:
            state = "COMPLETED"
        print(f"{ARRAY}_{{file.stem.removeprefix('job_')}}|{{state}}|node0")
"""


def install(folder: Path) -> Path:
    """Write the commands into `folder` and prepend it to PATH."""
    folder.mkdir()
    for name, source in (("sbatch", SBATCH), ("srun", SRUN), ("sacct", SACCT)):
        (folder / name).write_text(f"#!{sys.executable}\n{textwrap.dedent(source)}")
        (folder / name).chmod(0o755)
    return folder

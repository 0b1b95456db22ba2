// SPDX-License-Identifier: MIT OR Apache-2.0
//! A Slurm of a test's own: controller, one node and key in a temporary directory, in a process namespace that ends with
//! the test, whatever becomes of it.

use std::net::TcpListener;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// What the namespace's first process does.
const START: &str = r#"
head -c 1024 /dev/urandom > munge.key && chmod 400 munge.key
munged --foreground --force --key-file="$PWD/munge.key" --socket="$PWD/munge.socket" --pid-file="$PWD/munge.pid" \
    --log-file="$PWD/munged.log" --seed-file="$PWD/munge.seed" --num-threads=1 &
until [ -S munge.socket ]; do sleep 0.05; done
slurmctld -D -c -f "$SLURM_CONF" &
slurmd -D -f "$SLURM_CONF" &
wait
"#;

/// A Slurm that runs for this test alone.
pub struct PrivateSlurm {
    dir: tempfile::TempDir,
    child: Child,
}

impl PrivateSlurm {
    /// `None`, with a printed reason, where it cannot be had.
    pub fn start() -> Option<Self> {
        for program in ["munged", "slurmctld", "slurmd", "sbatch", "squeue", "scontrol", "unshare"] {
            let found = Command::new("sh").args(["-c", &format!("command -v {program}")]).output();
            if !found.is_ok_and(|output| output.status.success()) {
                println!(
                    "skipped: {program} is not installed (Debian packages slurm-wlm, munge; `make test` installs them)"
                );
                return None;
            }
        }
        let namespaces = Command::new("unshare").args(["--pid", "--fork", "--mount-proc", "true"]).output();
        if !namespaces.is_ok_and(|output| output.status.success()) {
            println!("skipped: this user may not make process namespaces (the tests are run as root)");
            return None;
        }
        let dir = tempfile::tempdir().expect("a temporary directory");
        std::fs::write(dir.path().join("slurm.conf"), configuration(dir.path())).expect("writable");
        // Nothing here uses control groups; without a version named the node looks for the host's.
        let groups = format!("CgroupPlugin=cgroup/v1\nCgroupMountpoint={}/cgroup\n", dir.path().display());
        std::fs::write(dir.path().join("cgroup.conf"), groups).expect("writable");
        for folder in ["state", "spool", "cgroup"] {
            std::fs::create_dir(dir.path().join(folder)).expect("writable");
        }
        let log = std::fs::File::create(dir.path().join("start.log")).expect("writable");
        let mut command = Command::new("unshare");
        command.args(["--pid", "--fork", "--kill-child", "--mount-proc", "bash", "-c", START]);
        command.current_dir(dir.path()).env("SLURM_CONF", dir.path().join("slurm.conf"));
        command.stdin(Stdio::null()).stdout(log.try_clone().expect("a file")).stderr(log);
        // SAFETY: prctl is async-signal-safe. It ends the namespace when the test ends, even if that is killed.
        unsafe {
            command.pre_exec(|| match libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) {
                0 => Ok(()),
                _ => Err(std::io::Error::last_os_error()),
            });
        }
        let slurm = Self { child: command.spawn().expect("unshare starts"), dir };
        slurm.wait_until_idle();
        Some(slurm)
    }

    fn wait_until_idle(&self) {
        let until = Instant::now() + Duration::from_secs(60);
        loop {
            let state = self.run("sinfo", &["--noheader", "--format=%T"]);
            if String::from_utf8_lossy(&state.stdout).trim() == "idle" {
                return;
            }
            assert!(Instant::now() < until, "no idle node: {}", self.logs());
            std::thread::sleep(Duration::from_millis(200));
        }
    }

    fn logs(&self) -> String {
        let read = |name: &str| std::fs::read_to_string(self.dir.path().join(name)).unwrap_or_default();
        ["start.log", "munged.log", "slurmctld.log", "slurmd.log"].map(read).join("\n--\n")
    }

    /// A command that talks to this Slurm.
    pub fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command.env("SLURM_CONF", self.dir.path().join("slurm.conf"));
        command
    }

    /// Runs a client program of this Slurm.
    pub fn run(&self, program: &str, arguments: &[&str]) -> Output {
        self.command(program).args(arguments).output().expect("starts")
    }

    /// Processes of this Slurm, its jobs included: they all have its configuration in their environment.
    fn processes(&self) -> Vec<PathBuf> {
        let own = self.dir.path().join("slurm.conf").to_string_lossy().into_owned();
        let all = std::fs::read_dir("/proc").expect("a directory").flatten().map(|entry| entry.path());
        let mine = |path: &PathBuf| {
            let environment = std::fs::read(path.join("environ")).unwrap_or_default();
            environment.windows(own.len()).any(|part| part == own.as_bytes())
        };
        all.filter(mine).collect()
    }
}

impl Drop for PrivateSlurm {
    fn drop(&mut self) {
        // The first process of the namespace ends with its parent, and all others with the first.
        let _ = self.child.kill();
        let _ = self.child.wait();
        let until = Instant::now() + Duration::from_secs(20);
        while !self.processes().is_empty() {
            if Instant::now() > until {
                println!("still there: {:?}", self.processes());
                break;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

/// One node of all processors; no accounting, no control groups; requeued jobs start after seconds, not minutes.
fn configuration(dir: &Path) -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").expect("Linux");
    let host = host.trim().split('.').next().unwrap_or_default();
    let free = || TcpListener::bind("127.0.0.1:0").expect("a free port");
    let ports = [free(), free()].map(|listener| listener.local_addr().expect("bound").port());
    let cpus = std::thread::available_parallelism().map_or(1, usize::from);
    let memory = std::fs::read_to_string("/proc/meminfo").expect("Linux");
    let memory: u64 = memory
        .lines()
        .find_map(|line| line.strip_prefix("MemTotal:")?.trim().strip_suffix(" kB")?.trim().parse().ok())
        .expect("a size");
    let (memory_mib, dir) = (memory / 1024 / 2, dir.display());
    format!(
        "ClusterName=test\nSlurmctldHost={host}(127.0.0.1)\nSlurmUser=root\nSlurmdUser=root\n\
         AuthType=auth/munge\nCredType=cred/munge\nAuthInfo=socket={dir}/munge.socket,cred_expire=5\n\
         SlurmctldPort={}\nSlurmdPort={}\nStateSaveLocation={dir}/state\nSlurmdSpoolDir={dir}/spool\n\
         SlurmctldPidFile={dir}/slurmctld.pid\nSlurmdPidFile={dir}/slurmd.pid\n\
         SlurmctldLogFile={dir}/slurmctld.log\nSlurmdLogFile={dir}/slurmd.log\n\
         ProctrackType=proctrack/linuxproc\nTaskPlugin=task/none\nJobAcctGatherType=jobacct_gather/none\n\
         AccountingStorageType=accounting_storage/none\nSelectType=select/cons_tres\nSelectTypeParameters=CR_CPU\n\
         SwitchType=switch/none\nMpiDefault=none\nKillWait=2\nReturnToService=2\n\
         SchedulerParameters=batch_sched_delay=0,sched_interval=1\n\
         NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory={memory_mib}\n\
         PartitionName=test Nodes={host} Default=YES MaxTime=INFINITE State=UP\n",
        ports[0], ports[1]
    )
}

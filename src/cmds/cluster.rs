// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody cluster`: a session reconstructed by the machines of a Slurm cluster.

use super::failure::{Failure, number_in, print};
use super::reconstruct::{self, Opened, What};
use crate::base::{Exit, Scratch, regular, write_whole};
use crate::batch::collect_shards::Shards;
use crate::batch::key::COMMON_FILES;
use crate::batch::run::{self, Format};
use crate::cluster::{self, Answer, Job, Measured, ShardStatus, Slurm, State, Status, Wish, Work};
use crate::s3::remote::Remote;
use crate::s3::{Location, recordings, results};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Number of tasks in one array at most, where Slurm does not report its limit: Slurm's default.
const MOST_TASKS: u64 = 1001;

/// Spread a reconstruction over the machines of a Slurm cluster.
#[derive(clap::Args)]
#[command(after_help = "\
Example:
  fourdbody cluster submit sessions/walk-01 --calibration calibration.json --out clouds/walk-01 --hours 1
  fourdbody cluster status clouds/walk-01")]
pub struct Args {
    #[command(subcommand)]
    what: ClusterCommand,
}

#[derive(clap::Subcommand)]
enum ClusterCommand {
    Submit(Box<SubmitArgs>),
    Status(StatusArgs),
}

/// Submit a session as a job array of shards, with a collecting job behind it.
///
/// The tasks' time and memory follow from a measurement. Everything that is submitted is in OUT/cluster, to be read.
/// Shards that are finished already are left out, so that what has failed is submitted again by the same command.
#[derive(clap::Args)]
#[command(after_help = "\
Example:
  fourdbody cluster submit sessions/walk-01 --calibration calibration.json --out clouds/walk-01 --hours 1 \
--partition short")]
struct SubmitArgs {
    #[command(flatten)]
    what: What,
    /// Number of tasks, each a shard of the frame sets [default: by --hours].
    #[arg(long, value_name = "N", conflicts_with = "hours", value_parser = clap::value_parser!(u64).range(1..))]
    tasks: Option<u64>,
    /// Tasks that are expected to take this long, hours.
    #[arg(long, value_name = "H", default_value_t = 1.0)]
    #[arg(value_parser = number_in(0.01..=1000.0, "hours from 0.01 to 1000"))]
    hours: f64,
    /// Number of processors of each task.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=1024))]
    cpus: u64,
    /// Tasks that may run at once, so that a shared disk keeps up [default: as many as fit].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    at_once: Option<u64>,
    /// Memory of a task, MiB [default: twice what was measured].
    #[arg(long, value_name = "MIB", value_parser = clap::value_parser!(u64).range(1..))]
    memory: Option<u64>,
    /// What a frame set takes, as `reconstruct --timings` wrote it on a machine like the cluster's [default: measured
    /// here, on frame sets from the middle of the session].
    #[arg(long, value_name = "FILE")]
    timings: Option<PathBuf>,
    /// Where the results go instead of --out, s3://BUCKET/PREFIX: scripts, logs and summaries stay in --out. The tasks
    /// find the store's address and credentials in the environment (AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID, ...), as this
    /// command does.
    #[arg(long, value_name = "URL")]
    store: Option<PathBuf>,
    /// With s3:// locations: where a task stages frames and results, on its own node [default: its directory of
    /// temporary files].
    #[arg(long, value_name = "DIR")]
    scratch: Option<PathBuf>,
    /// Slurm partition for all jobs.
    #[arg(long, value_name = "NAME", value_parser = parse_word)]
    partition: Option<String>,
    /// Slurm account for all jobs.
    #[arg(long, value_name = "NAME", value_parser = parse_word)]
    account: Option<String>,
    /// A further option of sbatch, for instance --sbatch=--qos=high; may be repeated.
    #[arg(long, value_name = "OPTION", allow_hyphen_values = true, value_parser = parse_word)]
    sbatch: Vec<String>,
    /// The program, as compute nodes find it [default: this one].
    #[arg(long, value_name = "FILE")]
    program: Option<PathBuf>,
    /// Print the scripts; write and submit nothing.
    #[arg(long)]
    dry_run: bool,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

/// Print the progress of a submitted reconstruction.
///
/// Exit codes: 0 waiting, running, or done; 1 something has failed, or Slurm does not answer; 3 and 4 done, with frames
/// that are missing or damaged.
#[derive(clap::Args)]
#[command(after_help = "\
Example:
  fourdbody cluster status clouds/walk-01")]
struct StatusArgs {
    /// The directory that was submitted as --out.
    out: PathBuf,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    match &args.what {
        ClusterCommand::Submit(args) => submit(args),
        ClusterCommand::Status(args) => status(args),
    }
}

fn submit(args: &SubmitArgs) -> Result<Exit, Failure> {
    let slurm = Slurm::find();
    if !args.dry_run {
        slurm.as_ref().map_err(Failure::usage)?;
    }
    if location(&args.what.out)?.is_some() {
        return Err(Failure::usage(
            "--out is for scripts and logs, in a directory that all share; give the store as --store",
        ));
    }
    let out = absolute(&args.what.out)?;
    let store = args.store.as_deref().map(store).transpose()?;
    let (path, Opened { session, calibration, mut plan, .. }) =
        open(&args.what, |session| refuse_if_taken(session, &out, slurm.as_ref().ok().copied()))?;
    let program = match &args.program {
        // Looked for on the node.
        Some(name) if name.components().count() == 1 && name.to_str().is_some() => name.clone(),
        Some(program) => absolute(program)?,
        None => absolute(&std::env::current_exe().map_err(Failure::failed)?)?,
    };
    let measured = match &args.timings {
        Some(path) => Measured::load(path, plan.cameras.len()).map_err(Failure::usage)?,
        None => probe(args, &plan, &out)?,
    };
    let most_tasks = slurm.as_ref().ok().and_then(|slurm| slurm.most_tasks()).unwrap_or(MOST_TASKS);
    let wish = Wish { tasks: args.tasks, hours: args.hours, cpus: args.cpus, most_tasks };
    let frame_sets = plan.triggers.end - plan.triggers.start;
    let mut sizing = cluster::size(frame_sets, measured, wish).map_err(Failure::usage)?;
    sizing.memory_mib = args.memory.unwrap_or(sizing.memory_mib);
    let mut options = args.what.options(&plan.triggers);
    if let Some(scratch) = &args.scratch {
        options.extend(["--scratch".to_owned(), absolute(scratch)?.display().to_string()]);
    }
    // A dry run leaves nothing behind.
    let temporary = args.dry_run && store.is_some();
    let summaries = temporary.then(|| scratch(&std::env::temp_dir(), "summaries")).transpose()?;
    if let Some(summaries) = &summaries {
        plan.out.clone_from(&summaries.0);
    }
    if let Some(store) = &store {
        fetch_summaries(store, &plan.out)?;
    }
    let finished = Shards::new(session, &plan, &calibration, sizing.tasks).map_err(Failure::failed)?;
    finished.key().check(&plan.out).map_err(Failure::usage)?;
    let work = Work {
        program,
        session: path,
        out,
        store: store.as_ref().map(ToString::to_string),
        options,
        phase: !plan.formats.contains(&Format::Ply),
        parameters: finished.key().parameters(),
        triggers: [plan.triggers.start, plan.triggers.end],
    };
    let array = (0..sizing.tasks).filter(|shard| finished.summary(*shard).is_err()).collect();
    let mut job = Job::new(work, sizing, array, args.at_once, sbatch_options(args));
    if !args.dry_run {
        write_calibration(&args.what.calibration, &job.work.out)?;
        cluster::write_scripts(&job).map_err(Failure::failed)?;
        submit_scripts(slurm.map_err(Failure::usage)?, &mut job)?;
    }
    print(args.json, &serde_json::json!(job), || print_job(args, &job));
    Ok(Exit::Done)
}

/// The store that a path is, if it is one.
fn location(path: &Path) -> Result<Option<Location>, Failure> {
    Location::of(path).transpose().map_err(Failure::usage)
}

/// The store that the results go to.
fn store(url: &Path) -> Result<Location, Failure> {
    location(url)?
        .ok_or_else(|| Failure::usage(format!("--store {}: expected s3://BUCKET/PREFIX", url.display())))
}

/// A session, unless `refuse` does, and how scripts name it.
fn open(
    what: &What,
    refuse: impl FnOnce(&Path) -> Result<(), Failure>,
) -> Result<(PathBuf, Opened), Failure> {
    let Some(location) = location(&what.session)? else {
        let session = absolute(&what.session)?;
        refuse(&session)?;
        return Ok((session, what.open()?));
    };
    refuse(&what.session)?;
    // Its triggers and cameras, without any frame.
    let index = scratch(&std::env::temp_dir(), "index")?;
    let mut staged = what.clone();
    staged.session = index.0.join("session");
    let remote = Remote::new(location).map_err(Failure::failed)?;
    recordings::stage(&remote, &staged.session, &|_, _| false).map_err(Failure::failed)?;
    Ok((what.session.clone(), staged.open()?))
}

/// Fetches the summaries of a result in a store to `out`, where they are read.
fn fetch_summaries(store: &Location, out: &Path) -> Result<(), Failure> {
    let remote = Remote::new(store.clone()).map_err(Failure::failed)?;
    let named =
        |name: &str| COMMON_FILES.contains(&name) || (name.starts_with("summary") && name.ends_with(".json"));
    std::fs::create_dir_all(out).map_err(|e| Failure::at(out, e))?;
    results::fetch(&remote, out, &|_| false, &named).map(drop).map_err(Failure::failed)
}

/// A path that scripts can name, wherever they run.
fn absolute(path: &Path) -> Result<PathBuf, Failure> {
    let found = std::path::absolute(path).map_err(|e| Failure::usage(format!("{}: {e}", path.display())))?;
    if found.to_str().is_none_or(|text| text.contains(['\n', '\r'])) {
        return Err(Failure::usage(format!(
            "{}: expected a path of UTF-8 without line breaks, for scripts",
            path.display()
        )));
    }
    Ok(found)
}

/// A result that another session has, or that is being worked on, is left alone.
fn refuse_if_taken(session: &Path, out: &Path, slurm: Option<Slurm>) -> Result<(), Failure> {
    if !Job::exists(out) {
        return Ok(());
    }
    let job = Job::load(out).map_err(Failure::usage)?;
    if job.work.session != session {
        let (out, other) = (out.display(), job.work.session.display());
        return Err(Failure::usage(format!(
            "{out} has the results of {other}; choose another --out for {}",
            session.display()
        )));
    }
    let Some(slurm) = slurm else { return Ok(()) };
    let status = cluster::read(&job, slurm.tasks(&job.numbers()));
    let active = |state: State| matches!(state, State::Waiting | State::Running);
    if active(status.collecting) || status.shards.iter().any(|shard| active(shard.state)) {
        let numbers = job.numbers().iter().map(u64::to_string).collect::<Vec<_>>().join(" ");
        return Err(Failure::usage(format!(
            "{} is submitted already; `fourdbody cluster status` prints its progress, `scancel {numbers}` cancels it",
            out.display()
        )));
    }
    Ok(())
}

/// Makes a directory of this process in `folder`, which is removed when it is no longer needed.
fn scratch(folder: &Path, what: &str) -> Result<Scratch, Failure> {
    let path = folder.join(format!("fourdbody-{what}-{}", std::process::id()));
    std::fs::create_dir_all(&path).map_err(|e| Failure::at(&path, e))?;
    Ok(Scratch(path))
}

/// Reconstructs some frame sets from the middle of the session, in a directory that is removed again, and measures it.
fn probe(args: &SubmitArgs, plan: &run::Plan, out: &Path) -> Result<Measured, Failure> {
    // Where the results will be, so that writing them is measured, too.
    let folder = if args.dry_run { std::env::temp_dir() } else { cluster::folder(out) };
    let scratch = scratch(&folder, "probe")?;
    let (first, end) = (plan.triggers.start, plan.triggers.end);
    // As many as threads take on at once, so that the memory is that of a long run.
    let count = (end - first).min(args.cpus.max(2));
    let from = first + (end - first - count) / 2;
    let (timings, program) =
        (scratch.0.join("timings.json"), std::env::current_exe().map_err(Failure::failed)?);
    eprintln!("measuring {count} frame sets (--timings FILE spares this)");
    let mut command = Command::new(program);
    command.arg("reconstruct").arg(&args.what.session).arg("--calibration").arg(&args.what.calibration);
    command.arg("--out").arg(scratch.0.join("out")).arg("--timings").arg(&timings);
    command.args(args.what.options(&(from..from + count))).args(["--jobs", &args.cpus.to_string()]);
    let output = command.stdin(Stdio::null()).output().map_err(Failure::failed)?;
    if !matches!(output.status.code(), Some(0 | 3 | 4)) {
        let text = String::from_utf8_lossy(&output.stderr);
        return Err(Failure::failed(format!(
            "measuring {count} frame sets: {}\n{}",
            output.status,
            text.trim()
        )));
    }
    Measured::load(&timings, plan.cameras.len()).map_err(Failure::failed)
}

fn sbatch_options(args: &SubmitArgs) -> Vec<String> {
    let named = [("partition", &args.partition), ("account", &args.account)];
    let named = named.into_iter().filter_map(|(name, value)| Some(format!("--{name}={}", value.as_ref()?)));
    named.chain(args.sbatch.iter().cloned()).collect()
}

/// Copies the calibration for all tasks: the file may change while they wait.
fn write_calibration(calibration: &Path, out: &Path) -> Result<(), Failure> {
    let folder = cluster::folder(out);
    let path = folder.join("calibration.json");
    let copied = std::fs::create_dir_all(&folder)
        .and_then(|()| regular::read(calibration, regular::STATEMENT_BYTES))
        .and_then(|bytes| write_whole(&path, |file| file.write_all(&bytes)));
    copied.map_err(|e| Failure::at(&path, e))
}

fn submit_scripts(slurm: Slurm, job: &mut Job) -> Result<(), Failure> {
    let folder = cluster::folder(&job.work.out);
    if !job.array.is_empty() {
        job.array_job = Some(slurm.submit(&folder, "shards.sh", None).map_err(Failure::failed)?);
    }
    let collecting = slurm.submit(&folder, "collect.sh", job.array_job).and_then(|number| {
        job.collect_job = Some(number);
        job.save()
    });
    collecting.map_err(|error| {
        // No job is left behind that no file names.
        let taken_back: Vec<String> =
            job.numbers().iter().filter_map(|number| slurm.cancel(*number).err()).collect();
        Failure::failed([vec![error], taken_back].concat().join("\n"))
    })
}

fn print_job(args: &SubmitArgs, job: &Job) {
    let sizing = &job.sizing;
    println!(
        "{} frame sets in {} tasks of at most {}; each {} processors, {} MiB, {:.0} min expected, {} min at most \
         ({:.3} s of a processor a frame set)",
        job.work.triggers[1] - job.work.triggers[0],
        sizing.tasks,
        sizing.frame_sets_per_task,
        sizing.cpus,
        sizing.memory_mib,
        sizing.expected_min,
        sizing.limit_min,
        sizing.cpu_s_per_frame_set,
    );
    let finished = job.shards - job.array.len() as u64;
    if finished > 0 {
        println!("{finished} shards are finished already and left out");
    }
    if args.dry_run {
        for (name, text) in
            [("shards.sh", cluster::shards_script(job)), ("collect.sh", cluster::collect_script(job))]
        {
            println!("\n-- {name}\n{text}");
        }
        return;
    }
    if let Some(number) = job.array_job {
        println!("submitted the shards as job {number}");
    }
    if let Some(number) = job.collect_job {
        println!(
            "submitted the collecting job {number}; see: fourdbody cluster status {}",
            job.work.out.display()
        );
    }
}

fn status(args: &StatusArgs) -> Result<Exit, Failure> {
    let job = Job::load(&args.out).map_err(Failure::usage)?;
    // Slurm first: a task that is over by then has left its results, and does not seem to have failed.
    let answer = match Slurm::find() {
        Ok(slurm) => slurm.tasks(&job.numbers()),
        Err(reason) => Answer { notes: vec![reason], ..Answer::default() },
    };
    if let Some(url) = &job.work.store {
        fetch_summaries(&store(Path::new(url))?, &args.out)?;
    }
    let status = cluster::read(&job, answer);
    print(args.json, &serde_json::json!(status), || print_status(&status));
    Ok(match (status.state, &status.summary) {
        (State::Failed | State::Unknown, _) => Exit::Failure,
        (State::Done, Some(summary)) => reconstruct::exit_of(summary),
        _ => Exit::Done,
    })
}

fn print_status(status: &Status) {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for shard in &status.shards {
        *counts.entry(word(shard.state)).or_default() += 1;
    }
    let counts: Vec<String> = counts.into_iter().map(|(state, count)| format!("{count} {state}")).collect();
    println!(
        "{}: {} of {} frame sets; shards: {}",
        word(status.state),
        status.frame_sets_done,
        status.frame_sets,
        counts.join(", ")
    );
    for shard in &status.shards {
        let ShardStatus { shard: number, state, frame_sets, frame_sets_done, task } = shard;
        let task = task.as_ref().map_or_else(String::new, describe);
        println!("  shard {number}: {} {frame_sets_done}/{frame_sets}{task}", word(*state));
    }
    let task = status.collecting_task.as_ref().map_or_else(String::new, describe);
    println!("  collecting: {}{task}", word(status.collecting));
    if status.state == State::Failed {
        let logs = cluster::folder(Path::new(&status.out)).join("log");
        println!(
            "the logs of failed tasks are in {}; the same `cluster submit` again submits what is missing",
            logs.display()
        );
    }
    status.notes.iter().for_each(|note| println!("note: {note}"));
}

fn describe(task: &cluster::Task) -> String {
    let mut text = format!(" ({}", task.state);
    for (name, value) in [("", &task.reason), ("on ", &task.nodes), ("for ", &task.elapsed)] {
        if !value.is_empty() {
            text += &format!(", {name}{value}");
        }
    }
    if task.restarts > 0 {
        text += &format!(", started anew {} times", task.restarts);
    }
    text + ")"
}

fn word(state: State) -> &'static str {
    match state {
        State::Waiting => "waiting",
        State::Running => "running",
        State::Done => "done",
        State::Failed => "failed",
        State::Unknown => "unknown",
    }
}

/// What goes into a script's `#SBATCH` line as it is.
fn parse_word(text: &str) -> Result<String, String> {
    let fits = |c: char| c.is_ascii_graphic() && c != '#';
    let word = (!text.is_empty() && text.chars().all(fits)).then(|| text.to_owned());
    word.ok_or_else(|| format!("expected a word without spaces, found {text:?}"))
}

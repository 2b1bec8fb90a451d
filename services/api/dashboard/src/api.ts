/** The part of the public REST API that this page uses. */

import { freeConnections } from "./follow";
import { inLane } from "./lanes";
import type { OptionSchema } from "./optionField";

/** Time in ms after which a request for the state of a dome that is watched is given up. */
const DOME_PATIENCE_MS = 3000;
/** The same in ms for a dome that is asked for the first time, as a simulated dome then starts its process. */
export const FIRST_PATIENCE_MS = 20_000;

export type JobState =
  "SUBMITTED" | "QUEUED" | "RUNNING" | "CANCELLING" | "CANCELLED" | "SUCCEEDED" | "FAILED" | "DELETING";

/** A relative image error, 0.05 for 5 %, and one standard error. */
export interface Figure {
  value: number;
  se: number | null;
}

/** How well a fit went: the report's own judgement and numbers. */
export interface Verdict {
  /** One sentence that names the worst fault first. */
  headline: string;
  converged: boolean;
  /** Of a fit that converged: whether the numbers may be farther off than their standard errors. */
  doubtful: boolean;
  is_above_limit: boolean;
  limit: number;
  error_of: "held-out" | "fitted";
  /** Mean over the channels. */
  error: Figure;
  channels: Record<string, Figure>;
  enamel_thickness: Estimate | null;
  steps: number;
  advice: string;
}

export interface Job {
  id: string;
  number: number;
  state: JobState;
  created_s: number;
  changed_s: number;
  spec: { kind: string; capture: string | null; rig: { mouth: string } | null };
  failure: { code: string; message: string; stage: string | null } | null;
  /** Label that a person gave it. */
  name: string | null;
  /** Verdict on the fit of a job that succeeded; null before, and where an earlier version fitted it. */
  verdict: Verdict | null;
}

export interface Stage {
  stage: string;
  state: "waiting" | "running" | "finished" | "stopped";
  attempt: number;
  done: number;
  message: string;
}

/** How long until a job ends, in s; both limits are null where `reason` says why. */
export interface TimeRange {
  low_s: number | null;
  high_s: number | null;
  past_jobs: number;
  reason: string | null;
}

export interface JobDetail extends Job {
  stages: Stage[];
  /** Why a queued job does not start, or a running one does not go on; null if nothing keeps it. */
  waits_for: string | null;
  /** Null unless the job waits or runs. */
  remaining: TimeRange | null;
}

/** Options by name, with a default, limits and help each. */
export interface OptionsSchema {
  /** Kind of job -> options that it does not have. */
  foreign_options: Record<string, string[]>;
  properties: Record<string, OptionSchema>;
  $defs: Record<string, { properties?: Record<string, OptionSchema & { $ref?: string }> }>;
}

/** Options that are set together. */
export interface Preset {
  name: string;
  summary: string;
  options: Record<string, unknown>;
}

/** An uploaded capture. */
export interface Capture {
  id: string;
  state: "open" | "committed" | "expired";
  subject: string | null;
  created_s: number;
  bytes: number;
}

/** A capture with its files. */
export interface CaptureDetail extends Capture {
  files: { path: string }[];
}

/** A calibration by name, as it is listed. */
export interface NamedCalibration {
  name: string;
  state: "good" | "old" | "beyond its limits" | "not known";
  created_s: number;
  /** When it was calibrated, ISO 8601; null where it does not say. */
  made: string | null;
  valid_days: number | null;
  /** Limits that it exceeds, in words; null where it was held to none. */
  broken: string[] | null;
}

/** The receipt of a deleted job. */
export interface Deletion {
  job: string;
  files: number;
  bytes: number;
}

export interface JobEvent {
  id: number;
  time_s: number;
  attempt: number;
  stage: string | null;
  kind: "state" | "started" | "progress" | "log" | "step" | "preview" | "finished";
  message: string;
  done: number | null;
  data: Record<string, unknown>;
}

export interface Estimate {
  value: number;
  se: number | null;
  unit: string;
  determined: boolean;
  /** Parts of the standard error by source, largest first; absent where an earlier version fitted. */
  se_parts?: Record<string, number>;
}

/** Estimates by channel and parameter name. */
export type Parameters = Record<string, Record<string, Estimate>>;

export interface Artifact {
  path: string;
  bytes: number;
  media_type: string;
}

export interface JobPage {
  jobs: Job[];
  next_before: number | null;
}

export interface Worker {
  name: string;
  host: string;
  /** Stages that the worker runs, wholly or in part, or will run next. */
  tasks: { stage: string; job: string | null }[];
  /** Whether captures, and whether all other stages, may run there. */
  has_dome: boolean;
  runs_stages: boolean;
  /** What the worker was started for and cannot do; empty where nothing is wrong. */
  fault: string;
  memory_bytes: number;
  memory_limit_bytes: number | null;
}

export interface Workers {
  workers: Worker[];
  /** How many workers there are, or why there are none yet. */
  sentence: string;
  succeeded_last_hour: number;
  succeeded_last_day: number;
}

export interface Session {
  name: string;
  scopes: string[];
  is_open: boolean;
  /**
   * Key that allows ALL OFF and nothing else; null where the server asks nobody for a token, or the token may not work
   * the dome.
   */
  dark_key: string | null;
}

/** A token on the one occasion when its secret is shown. */
export interface IssuedToken {
  name: string;
  token: string;
}

export interface DomeStatus {
  firmware: string;
  light_count: number;
  interlock_closed: boolean;
  emergency_stop: boolean;
  supply_on: boolean;
  /** Whether ALL OFF is in force: no light goes on until somebody starts anew. */
  stopped: boolean;
  faults: string[];
  /** Lights that emit now. */
  lit: number[];
  /** Temperature of each bank of lights, in °C. */
  temperature_degc: number[];
  /** Current of each bank of lights, in mA. */
  current_ma: number[];
}

export interface DomeState {
  address: string;
  status: DomeStatus;
  /** Jobs whose capture is under way, of those that this page may show. */
  capturing: string[];
  others_capturing: number;
}

export interface AllOff {
  status: DomeStatus;
  /** Jobs that were cancelled, of those that this page may show. */
  stopped: string[];
  others_stopped: number;
}

/** The server answers with an error; the message is the sentence of its answer. */
export class Refusal extends Error {
  constructor(
    sentence: string,
    readonly status: number,
  ) {
    super(sentence);
  }
}

/** The server does not know the caller; a token is needed. */
export class Unauthenticated extends Refusal {}

/**
 * Whether the same request may succeed later: the server cannot be reached, there were too many requests, or it failed
 * itself.
 */
export function mayPass(problem: unknown): boolean {
  return (
    problem instanceof TypeError || (problem instanceof Refusal && (problem.status === 429 || problem.status >= 500))
  );
}

export function sentenceOf(problem: unknown): string {
  if (problem instanceof DOMException && problem.name === "TimeoutError") return "The server does not answer.";
  if (problem instanceof TypeError) return "The server cannot be reached.";
  return problem instanceof Error ? problem.message : String(problem);
}

export async function ask<T>(
  path: string,
  method = "GET",
  headers: Record<string, string> = {},
  body?: object,
): Promise<T> {
  const sent = body
    ? { method, headers: { ...headers, "Content-Type": "application/json" }, body: JSON.stringify(body) }
    : { method, headers };
  return inLane(() => request<T>(path, sent));
}

async function request<T>(path: string, sent: RequestInit): Promise<T> {
  const answer = await fetch(`/v1${path}`, sent);
  if (!answer.ok) {
    const problem = await answer.json().catch(() => null);
    throw new (answer.status === 401 ? Unauthenticated : Refusal)(
      problem?.detail ?? `The server answered ${answer.status}.`,
      answer.status,
    );
  }
  return (answer.status === 204 ? undefined : answer.json()) as Promise<T>;
}

export const getSession = (): Promise<Session> => ask("/session");
export const signIn = (token: string): Promise<Session> =>
  ask("/session", "POST", { Authorization: `Bearer ${token}` });
export const setUp = (secret: string): Promise<IssuedToken> => ask("/setup", "POST", {}, { secret });
export const signOut = (): Promise<void> => ask("/session", "DELETE");

export const listJobs = (limit: number, before?: number): Promise<JobPage> =>
  ask(`/jobs?limit=${limit}${before === undefined ? "" : `&before=${before}`}`);
export const listWorkers = (): Promise<Workers> => ask("/workers");
export const getJob = (id: string): Promise<JobDetail> => ask(`/jobs/${id}`);
export const getOptions = (): Promise<OptionsSchema> => ask("/options");
export const listPresets = (): Promise<Preset[]> => ask("/presets");
export const getPreset = (name: string): Promise<Preset> => ask(`/presets/${name}`);
export const listCaptures = (): Promise<{ captures: Capture[] }> => ask("/captures?limit=500");
export const getCapture = (id: string): Promise<CaptureDetail> => ask(`/captures/${id}`);
export const listCalibrations = (): Promise<NamedCalibration[]> => ask("/calibrations");
/** Store the calibration that a job has made under a name. */
export const keepCalibration = (job: string, name: string): Promise<NamedCalibration> =>
  ask(`/jobs/${job}/calibration/${encodeURIComponent(name)}`, "PUT");
export const submitJob = (options: object): Promise<Job> => ask("/jobs", "POST", {}, options);
export const renameJob = (id: string, name: string | null): Promise<Job> => ask(`/jobs/${id}`, "PATCH", {}, { name });
export const deleteJob = (id: string): Promise<Deletion> => ask(`/jobs/${id}`, "DELETE");
export const cancelJob = (id: string): Promise<Job> => ask(`/jobs/${id}/cancel`, "POST");
export const retryJob = (id: string): Promise<Job> => ask(`/jobs/${id}/retry`, "POST");
export const getDome = (patienceMs = DOME_PATIENCE_MS): Promise<DomeState> =>
  inLane(() => request("/dome", { signal: AbortSignal.timeout(patienceMs) }));

/**
 * Switch every light off. The request waits for no lane, and the stream of events closes to free a connection for it.
 * Where the server asks for tokens it is sent without the cookie and with the dark key of the session: browsers keep
 * connections with and without cookies apart, so that this one is free whatever else is under way, downloads too. Where
 * the key fails, the cookie is tried: darkening twice is harmless.
 */
export async function allOff(session: Session | null): Promise<AllOff> {
  freeConnections();
  const off = (how: RequestInit): Promise<AllOff> => request("/dome/off", { method: "POST", priority: "high", ...how });
  if (session?.is_open) return off({ credentials: "omit" });
  if (!session?.dark_key) return off({});
  try {
    return await off({ credentials: "omit", headers: { Authorization: `Bearer ${session.dark_key}` } });
  } catch {
    return off({});
  }
}

/**
 * Ask for nothing but that the connection for ALL OFF, the one without the cookie, stays open: a server that a flood of
 * connections reaches accepts a new one late, and serves an open one at once.
 */
export async function keepOffConnection(): Promise<void> {
  const sent: RequestInit = { credentials: "omit", cache: "no-store", signal: AbortSignal.timeout(DOME_PATIENCE_MS) };
  await fetch("/v1/health/live", sent).catch(() => undefined);
}

export const lightUp = (light: number, level: number, on_s: number): Promise<DomeStatus> =>
  ask("/dome/light", "PUT", {}, { light, level, on_s });
export const darken = (): Promise<DomeStatus> => ask("/dome/light", "DELETE");
export const preflight = (mouth: string): Promise<{ findings: string[] }> =>
  ask("/dome/preflight", "POST", {}, { mouth });
export const listArtifacts = (id: string): Promise<Artifact[]> => ask(`/jobs/${id}/artifacts`);
export const getParameters = (id: string): Promise<Parameters> => ask(`/jobs/${id}/artifacts/parameters.json`);

export const archiveUrl = (id: string): string => `/v1/jobs/${id}/artifacts.zip`;
export const parameterTableUrl = (id: string): string => `/v1/jobs/${id}/parameters.csv`;

export function artifactUrl(id: string, path: string): string {
  return `/v1/jobs/${id}/artifacts/${path.split("/").map(encodeURIComponent).join("/")}`;
}

/** Polls `/readyz` until the service can draw and has nothing left to prepare. */

/** What the service prepares, in its own words; `total` is 0 while it is not known. */
export interface Preparation {
  readonly task: string;
  readonly done: number;
  readonly total: number;
  /** Seconds since the service began to prepare; null: it does not say. */
  readonly elapsed: number | null;
}

export interface Readiness {
  /** `starting`: the service answers, but cannot draw yet. */
  readonly phase: 'unknown' | 'unreachable' | 'starting' | 'ready';
  readonly preparing: Preparation | null;
  /** Whether the service's device is calibrated, in its own word; null: it does not say. */
  readonly calibration: string | null;
}

const UNREACHABLE: Readiness = { phase: 'unreachable', preparing: null, calibration: null };
const NOT_READY = 503;
/** A proxy sends these where the service behind it does not answer. */
export const GATEWAY_ERRORS: ReadonlySet<number> = new Set([502, 504]);

const STARTING_MS = 500;
const PREPARING_MS = 2000;
const RETRY_MS = [1000, 2000, 4000, 8000] as const;
/** Before anything is drawn nothing else holds the browser's connections, so an answer takes milliseconds. */
const TIMEOUT_MS = 10_000;

/** What an answer of `/readyz` says. Where it is hidden (404, 403), requests are sent as if the service were ready, and fail in words. */
export function readinessOf(status: number, body: unknown): Readiness {
  const isDocument = typeof body === 'object' && body !== null;
  // A proxy's own 503 is a page.
  if (GATEWAY_ERRORS.has(status) || (status === NOT_READY && !isDocument)) return UNREACHABLE;
  const preparing = isDocument && 'preparing' in body ? preparationIn(body.preparing) : null;
  const calibration = isDocument && 'calibration' in body && typeof body.calibration === 'string' ? body.calibration : null;
  return { phase: status === NOT_READY ? 'starting' : 'ready', preparing, calibration };
}

function preparationIn(value: unknown): Preparation | null {
  if (typeof value !== 'object' || value === null) return null;
  const { task, done, total, elapsed_s: elapsed } = value as Record<string, unknown>;
  const count = (given: unknown) => (typeof given === 'number' && given > 0 ? given : 0);
  return typeof task === 'string' && task
    ? { task, done: Math.min(count(done), count(total)), total: count(total), elapsed: typeof elapsed === 'number' ? elapsed : null }
    : null;
}

/** Milliseconds until `/readyz` is asked again; null: no more. */
export function pauseAfter({ phase, preparing }: Readiness, failures: number): number | null {
  switch (phase) {
    case 'unreachable': return RETRY_MS[Math.min(failures, RETRY_MS.length) - 1] ?? RETRY_MS[0];
    case 'starting': return STARTING_MS;
    default: return preparing ? PREPARING_MS : null;
  }
}

export class ReadinessPoll {
  #current: Readiness = { phase: 'unknown', preparing: null, calibration: null };
  #failures = 0;
  #timer: ReturnType<typeof setTimeout> | undefined;
  #pending: Promise<Readiness> | null = null;
  readonly #listeners = new Set<(readiness: Readiness) => void>();

  constructor(private readonly address: string) {}

  get current(): Readiness {
    return this.#current;
  }

  /** Calls `hear` after each answer. Returns what ends that. */
  watch(hear: (readiness: Readiness) => void): () => void {
    this.#listeners.add(hear);
    return () => this.#listeners.delete(hear);
  }

  /** Asks now, and then again and again until nothing is left to prepare. Never throws. */
  check(): Promise<Readiness> {
    clearTimeout(this.#timer);
    this.#pending ??= this.#ask().then((readiness) => {
      this.#pending = null;
      this.#current = readiness;
      this.#failures = readiness.phase === 'unreachable' ? this.#failures + 1 : 0;
      const pause = pauseAfter(readiness, this.#failures);
      if (pause !== null) this.#timer = setTimeout(() => void this.check(), pause);
      for (const hear of [...this.#listeners]) hear(readiness);
      return readiness;
    });
    return this.#pending;
  }

  /** Waits until the service is in one of the phases. Throws an `AbortError` where the signal ends that. */
  async until(phases: readonly Readiness['phase'][], signal?: AbortSignal | null): Promise<void> {
    const reached = () => phases.includes(this.#current.phase);
    if (reached()) return;
    await new Promise<void>((resolve, reject) => {
      const abort = () => {
        stop();
        reject(new DOMException('aborted', 'AbortError'));
      };
      const stop = this.watch(() => {
        if (!reached()) return;
        stop();
        signal?.removeEventListener('abort', abort);
        resolve();
      });
      if (signal?.aborted) abort();
      else signal?.addEventListener('abort', abort, { once: true });
    });
  }

  async #ask(): Promise<Readiness> {
    // Once tiles are asked for, they hold the browser's connections for as long as they take: a late answer means nothing then.
    const signal = this.#current.phase === 'ready' ? null : AbortSignal.timeout(TIMEOUT_MS);
    try {
      const response = await fetch(this.address, { cache: 'no-store', signal });
      return readinessOf(response.status, await response.json().catch(() => null));
    } catch {
      return UNREACHABLE;
    }
  }
}

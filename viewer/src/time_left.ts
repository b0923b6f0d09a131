/** Estimate of the time that a preparation still takes, and durations in words. */

import type { Preparation } from './readiness';

/** Less than this of a task says nothing of the rest: loops differ in how long they take to compile. */
const MIN_SEEN_S = 5;
const MIN_SEEN_SHARE = 0.1;
/** After so long without a step, the steps before say nothing of the next one. */
const MAX_PAUSE_S = 15;
/** After so long without any change, somebody should look. */
const STALLED_S = 90;

interface Sample {
  readonly at: number;
  readonly done: number;
}

export class ProgressWatch {
  #task = '';
  #total = -1;
  #first: Sample = { at: 0, done: 0 };
  #last: Sample = { at: 0, done: 0 };

  /** Takes in what is said at a moment (seconds of any clock). Another task, another total, or less than before begins anew. */
  see({ task, done, total }: Preparation, now: number): void {
    if (task !== this.#task || total !== this.#total || done < this.#last.done) {
      [this.#task, this.#total] = [task, total];
      this.#first = this.#last = { at: now, done };
    } else if (done > this.#last.done) {
      this.#last = { at: now, done };
    }
  }

  /** Seconds; null where the progress so far does not tell. */
  secondsLeft(now: number): number | null {
    const steps = this.#last.done - this.#first.done;
    const seen = now - this.#first.at;
    if (this.#total <= 0 || steps < MIN_SEEN_SHARE * this.#total || seen < MIN_SEEN_S) return null;
    if (now - this.#last.at > MAX_PAUSE_S) return null;
    return ((this.#total - this.#last.done) * seen) / steps;
  }

  /** Whether nothing has moved for so long that something may be wrong. */
  isStalled(now: number): boolean {
    return this.#task !== '' && now - this.#last.at > STALLED_S;
  }
}

/** 34 s; 2 min 5 s */
export function elapsedText(seconds: number): string {
  const whole = Math.floor(seconds);
  return whole < 60 ? `${whole} s` : `${Math.floor(whole / 60)} min ${whole % 60} s`;
}

/** A time that is not known exactly, rounded up so that it does not flicker. */
export function leftText(seconds: number): string {
  if (seconds < 8) return 'a few seconds left';
  if (seconds <= 55) return `about ${Math.ceil(seconds / 5) * 5} s left`;
  return `about ${Math.ceil(seconds / 60)} min left`;
}

/** What the page says of its work: a line that runs while tiles are on their way, words where that takes long, and failures. */

import { byId } from './dom';
import type { Progress } from './tiles';

/** After so long somebody wonders. */
const SLOW_MS = 5000;
const SHOWN_AFTER_MS = 250;

/** What the service does. The count changes often: screen readers leave it out. */
export interface Note {
  readonly words: string;
  readonly count: string;
  /** Whether the map is drawn meanwhile. */
  readonly quiet: boolean;
}

export class Status {
  readonly #box = byId('status');
  readonly #words = byId('status-words');
  readonly #count = byId('status-count');
  readonly #again = byId<HTMLButtonElement>('again');
  #failure = '';
  #slow = false;
  #note: Note | null = null;
  #busy = false;
  #timers: ReturnType<typeof setTimeout>[] = [];

  constructor(again: () => void) {
    this.#again.addEventListener('click', () => {
      this.clear();
      again();
    });
  }

  progress({ waiting, failed, message }: Progress): void {
    if (failed) this.fail(`${failed === 1 ? 'A tile is' : `${failed} tiles are`} missing: ${message}`);
    this.#work(waiting > 0);
  }

  fail(words: string): void {
    this.#failure = words;
    this.#refresh();
  }

  /** Says what the service does, unless something has failed; null: nothing. */
  note(note: Note | null): void {
    this.#note = note;
    this.#refresh();
  }

  /** Takes back what was said of tiles. */
  clear(): void {
    this.#failure = '';
    this.#slow = false;
    this.#refresh();
  }

  #work(busy: boolean): void {
    if (busy === this.#busy) return;
    this.#busy = busy;
    document.body.dataset.busy = String(busy);
    this.#timers.forEach(clearTimeout);
    this.#timers = [];
    this.#slow = false;
    if (busy) {
      this.#timers.push(
        setTimeout(() => document.body.classList.add('working'), SHOWN_AFTER_MS),
        setTimeout(() => {
          this.#slow = true;
          this.#refresh();
        }, SLOW_MS),
      );
    } else {
      document.body.classList.remove('working');
    }
    this.#refresh();
  }

  #refresh(): void {
    const note = this.#note;
    const slow = this.#slow && (note?.quiet ?? true) && `Still drawing. ${note?.words ?? 'What nobody has looked at before takes a while.'}`;
    const words = this.#failure || slow || note?.words || '';
    const count = !this.#failure && note?.count;
    this.#box.hidden = !words;
    this.#box.classList.toggle('failed', Boolean(this.#failure));
    this.#box.classList.toggle('quiet', !this.#failure && !slow && note?.quiet === true);
    if (this.#words.textContent !== words) this.#words.textContent = words;
    this.#count.textContent = count ? `: ${count}` : '';
    this.#again.hidden = !this.#failure;
  }
}

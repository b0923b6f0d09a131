/** Progress bar while tiles are loading, a message if that takes long, and error messages. */

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
  readonly #halt = byId<HTMLButtonElement>('halt');
  #failure = '';
  #slow = false;
  /** What is drawn, where that is to be said at once; and what the day waits for. */
  #subject = '';
  #day: Note | null = null;
  #tiles = '';
  #note: Note | null = null;
  #busy = false;
  #timers: ReturnType<typeof setTimeout>[] = [];

  constructor(again: () => void, halt: () => void) {
    this.#halt.addEventListener('click', halt);
    this.#again.addEventListener('click', () => {
      this.clear();
      again();
    });
  }

  progress({ waiting, asked, failed, message }: Progress): void {
    if (failed) this.fail(`${failed === 1 ? 'A tile is' : `${failed} tiles are`} missing: ${message}`);
    this.#tiles = asked > 1 ? `${asked - waiting} of ${asked} tiles` : '';
    this.working(waiting > 0);
    if (waiting) this.#refresh();
  }

  /** Names what is drawn as long as something is, from its beginning on; empty: words come only where it takes long. */
  subject(words: string): void {
    this.#subject = words;
    this.#refresh();
  }

  /** Says what playing the day waits for, with a way to stop; null: it does not wait. */
  waitForDay(note: Note | null): void {
    this.#day = note;
    this.#refresh();
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

  /** Whether something is on its way. */
  working(busy: boolean): void {
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
    const note = this.#said();
    this.#box.hidden = !note;
    this.#box.classList.toggle('failed', Boolean(this.#failure));
    this.#box.classList.toggle('quiet', note?.quiet === true);
    if (this.#words.textContent !== (note?.words ?? '')) this.#words.textContent = note?.words ?? '';
    this.#count.textContent = note?.count ? `: ${note.count}` : '';
    this.#again.hidden = !this.#failure;
    this.#halt.hidden = Boolean(this.#failure) || !this.#day;
  }

  /** What matters most of all that there is to say. */
  #said(): Note | null {
    const note = this.#note;
    if (this.#failure) return { words: this.#failure, count: '', quiet: false };
    if (this.#day) return this.#day;
    if (!this.#busy || !(note?.quiet ?? true)) return note;
    if (this.#slow) {
      const words = `Still drawing. ${note?.words ?? (this.#subject || 'What nobody has looked at before takes a while.')}`;
      return { words, count: note?.count ?? (this.#subject && this.#tiles), quiet: false };
    }
    return this.#subject ? { words: this.#subject, count: this.#tiles, quiet: false } : note;
  }
}

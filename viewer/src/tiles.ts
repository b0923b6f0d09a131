/** Cache of tiles by URL, for the map and the player. */

import { type Service, isAbort, inWords } from './service';

const MOST_BYTES = 128 * 2 ** 20;

/** How many tiles are on their way, how many failed since the last `reset`, and why the last of them did. */
export interface Progress {
  readonly waiting: number;
  /** Since last none was on its way. */
  readonly asked: number;
  readonly failed: number;
  readonly message: string;
}

export class Tiles {
  /** In the order of their last use. */
  readonly #kept = new Map<string, ArrayBuffer>();
  #bytes = 0;
  #progress: Progress = { waiting: 0, asked: 0, failed: 0, message: '' };
  readonly #service: Service;
  readonly #tell: (progress: Progress) => void;

  constructor(service: Service, tell: (progress: Progress) => void) {
    this.#service = service;
    this.#tell = tell;
  }

  has(address: string): boolean {
    return this.#kept.has(address);
  }

  /** The bytes of a tile; a copy, which may be given away. Throws as `Service.request` does. `quiet`: not told of as progress. */
  async bytes(address: string, signal?: AbortSignal, quiet = false): Promise<ArrayBuffer> {
    const kept = this.#kept.get(address);
    if (kept) {
      this.#kept.delete(address);
      this.#kept.set(address, kept);
      return kept.slice(0);
    }
    await this.#service.readiness.until(['ready'], signal);
    if (!quiet) this.#change({ waiting: this.#progress.waiting + 1, asked: this.#progress.asked + 1 });
    try {
      const response = await this.#service.request(address, { signal });
      const bytes = await response.arrayBuffer();
      this.#keep(address, bytes);
      return bytes.slice(0);
    } catch (error) {
      if (!quiet && !isAbort(error)) this.#change({ failed: this.#progress.failed + 1, message: inWords(error) });
      throw error;
    } finally {
      if (!quiet) this.#change({ waiting: this.#progress.waiting - 1, asked: this.#progress.waiting > 1 ? this.#progress.asked : 0 });
    }
  }

  /** Forgets failures: what is asked for next starts anew. */
  reset(): void {
    this.#change({ failed: 0, message: '' });
  }

  #keep(address: string, bytes: ArrayBuffer): void {
    if (this.#kept.has(address)) return;
    this.#kept.set(address, bytes);
    this.#bytes += bytes.byteLength;
    for (const [oldest, old] of this.#kept) {
      if (this.#bytes <= MOST_BYTES) break;
      this.#kept.delete(oldest);
      this.#bytes -= old.byteLength;
    }
  }

  #change(change: Partial<Progress>): void {
    this.#progress = { ...this.#progress, ...change };
    this.#tell(this.#progress);
  }
}

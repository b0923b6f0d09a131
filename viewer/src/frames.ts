/** Frames of the map at other times, composed of tiles: prefetched, cached, and keyed by URL. */

import { TILE_MATRIX_SET } from './service';
import type { Tiles } from './tiles';

const TILE_PX = 256;
const TILE_BYTES = TILE_PX ** 2 * 4;
/** Decoded pictures take 4 bytes a pixel; older ones are put together anew from their tiles. */
const MOST_BYTES = 512 * 2 ** 20;
const [LEAST_TILES, MOST_TILES] = [12, 48];

/** A rectangle of tiles of a zoom. */
export interface Range {
  readonly zoom: number;
  readonly left: number;
  readonly top: number;
  readonly cols: number;
  readonly rows: number;
}

/** West, south, east and north in degrees. */
export type Bounds = readonly [number, number, number, number];

const column = (lon: number, zoom: number) => ((lon + 180) / 360) * 2 ** zoom;
const row = (lat: number, zoom: number) => (0.5 - Math.asinh(Math.tan((lat * Math.PI) / 180)) / (2 * Math.PI)) * 2 ** zoom;
const lonOf = (col: number, zoom: number) => (col / 2 ** zoom) * 360 - 180;
const latOf = (down: number, zoom: number) => (Math.atan(Math.sinh(Math.PI * (1 - (2 * down) / 2 ** zoom))) * 180) / Math.PI;

/** So many tiles a picture may have, that so many pictures stay: shown round and round, all would go before they come again. */
export const tilesOfEach = (pictures: number) => Math.max(LEAST_TILES, Math.min(MOST_TILES, Math.floor(MOST_BYTES / (pictures * TILE_BYTES))));

/** The tiles that cover what is seen of a level, at a zoom or, where they are more than `most`, a coarser one; null: none is seen. */
export function rangeOver(seen: Bounds, level: Bounds, zoom: number, minzoom: number, most = MOST_TILES): Range | null {
  const [west, east] = [Math.max(seen[0], level[0]), Math.min(seen[2], level[2])];
  const [south, north] = [Math.max(seen[1], level[1]), Math.min(seen[3], level[3])];
  if (west >= east || south >= north) return null;
  for (let at = zoom; ; at -= 1) {
    const [left, top] = [Math.floor(column(west, at)), Math.floor(row(north, at))];
    const [cols, rows] = [Math.ceil(column(east, at)) - left, Math.ceil(row(south, at)) - top];
    if (cols * rows <= most || at <= minzoom) return { zoom: at, left, top, cols, rows };
  }
}

/** The corners of a range from the upper left clockwise, longitude and latitude. */
export function cornersOf({ zoom, left, top, cols, rows }: Range): [[number, number], [number, number], [number, number], [number, number]] {
  const [west, east] = [lonOf(left, zoom), lonOf(left + cols, zoom)];
  const [north, south] = [latOf(top, zoom), latOf(top + rows, zoom)];
  return [[west, north], [east, north], [east, south], [west, south]];
}

/** How many tiles of a picture are there. */
export interface FrameProgress {
  readonly done: number;
  readonly all: number;
}

export class Frames {
  readonly #progress = new Map<string, FrameProgress>();
  /** In the order of their last use. */
  readonly #made = new Map<string, HTMLCanvasElement>();
  readonly #coming = new Map<string, Promise<HTMLCanvasElement>>();
  readonly #tiles: Tiles;

  constructor(tiles: Tiles) {
    this.#tiles = tiles;
  }

  /** The picture of a range from tiles of a template, if it is ready. */
  get(template: string, range: Range): HTMLCanvasElement | undefined {
    return this.#made.get(keyOf(template, range));
  }

  /** How far a picture is that is being put together. */
  progress(template: string, range: Range): FrameProgress | undefined {
    return this.#progress.get(keyOf(template, range));
  }

  /** Fetches what it lacks and puts the picture together. Throws as `Service.request` does. */
  async load(template: string, range: Range, signal: AbortSignal): Promise<HTMLCanvasElement> {
    const key = keyOf(template, range);
    const made = this.#made.get(key);
    if (made) {
      this.#made.delete(key);
      this.#made.set(key, made);
      return made;
    }
    const coming = this.#coming.get(key) ?? this.#make(template, range, signal).finally(() => {
      this.#coming.delete(key);
      this.#progress.delete(key);
    });
    this.#coming.set(key, coming);
    const picture = await coming;
    this.#made.set(key, picture);
    let bytes = [...this.#made.values()].reduce((sum, each) => sum + each.width * each.height * 4, 0);
    for (const [oldest, { width, height }] of this.#made) {
      if (bytes <= MOST_BYTES || oldest === key) break;
      this.#made.delete(oldest);
      bytes -= width * height * 4;
    }
    return picture;
  }

  async #make(template: string, range: Range, signal: AbortSignal): Promise<HTMLCanvasElement> {
    const picture = Object.assign(document.createElement('canvas'), { width: range.cols * TILE_PX, height: range.rows * TILE_PX });
    const pen = picture.getContext('2d');
    const [key, all] = [keyOf(template, range), range.cols * range.rows];
    this.#progress.set(key, { done: 0, all });
    const places = Array.from({ length: range.cols * range.rows }, (_, index) => [index % range.cols, Math.floor(index / range.cols)] as const);
    await Promise.all(places.map(async ([x, y]) => {
      const address = template
        .replace('{z}', String(range.zoom)).replace('{x}', String(range.left + x)).replace('{y}', String(range.top + y));
      const bytes = await this.#tiles.bytes(address, signal, true);
      this.#progress.set(key, { done: (this.#progress.get(key)?.done ?? 0) + 1, all });
      // An empty answer (204) is a tile without data.
      if (!bytes.byteLength) return;
      const tile = await createImageBitmap(new Blob([bytes]));
      pen?.drawImage(tile, x * TILE_PX, y * TILE_PX);
      tile.close();
    }));
    return picture;
  }
}

function keyOf(template: string, { zoom, left, top, cols, rows }: Range): string {
  return `${template} ${TILE_MATRIX_SET} ${zoom}/${left}/${top} ${cols}x${rows}`;
}

/** Canvas over a map layer that shows a film's frames. It changes only when the next frame is complete. */

import type { CanvasSource, Map as MapLibre } from 'maplibre-gl';

import { type Range, cornersOf } from './frames';
import { LAYER } from './map';

const CANVAS = 'frames';
const TILE_PX = 256;

export class FrameCanvas {
  readonly #canvas = document.createElement('canvas');
  #range: Range | null = null;
  #shown: HTMLCanvasElement | null = null;

  constructor(readonly map: MapLibre) {}

  /** The tiles that it covers; null: it is not on the map. */
  get range(): Range | null {
    return this.#range;
  }

  /** Puts the canvas over the tiles of a range; it is painted before anybody sees it. */
  lay(range: Range): void {
    if (this.#range && same(range, this.#range)) return;
    const before = this.#shown ? this.#range : null;
    this.#range = range;
    this.#shown = null;
    if (!before || before.cols !== range.cols || before.rows !== range.rows || !this.#source) {
      this.#takeAway();
      Object.assign(this.#canvas, { width: range.cols * TILE_PX, height: range.rows * TILE_PX });
    } else {
      this.#source.setCoordinates(cornersOf(range));
    }
  }

  /** Paints a share of a picture, 0 to 1, over the one before; both together are always a whole one. */
  paint(picture: HTMLCanvasElement, share: number): void {
    const pen = this.#canvas.getContext('2d');
    if (!pen) return;
    const from = this.#shown;
    pen.globalCompositeOperation = 'copy';
    pen.globalAlpha = from ? share : 1;
    pen.drawImage(picture, 0, 0);
    if (from && share < 1) {
      // Sums of premultiplied colours: what is transparent in both stays so, what is opaque in both, too.
      pen.globalCompositeOperation = 'lighter';
      pen.globalAlpha = 1 - share;
      pen.drawImage(from, 0, 0);
    }
  }

  /** The picture that the next one is painted over. */
  keep(picture: HTMLCanvasElement): void {
    this.#shown = picture;
  }

  /** Shows what is painted. With `hidesLayer` the layer below is not seen: two shadows would be twice as dark. */
  show(opacity: number, hidesLayer: boolean): void {
    const source = this.#source;
    source?.play();
    if (source || !this.#range) return;
    this.map.addSource(CANVAS, { type: 'canvas', canvas: this.#canvas, coordinates: cornersOf(this.#range), animate: true });
    const ids = this.map.getStyle().layers.map(({ id }) => id);
    this.map.addLayer(
      { id: CANVAS, type: 'raster', source: CANVAS, paint: { 'raster-fade-duration': 0, 'raster-opacity': opacity } },
      ids[ids.indexOf(LAYER) + 1],
    );
    if (hidesLayer && this.map.getLayer(LAYER)) this.map.setPaintProperty(LAYER, 'raster-opacity', 0);
  }

  /** A canvas that may change keeps the map from coming to rest. */
  pause(): void {
    this.#source?.pause();
  }

  /** Takes the canvas off the map. */
  clear(): void {
    this.#takeAway();
    this.#range = null;
    this.#shown = null;
  }

  get #source(): CanvasSource | undefined {
    return this.map.getSource<CanvasSource>(CANVAS);
  }

  #takeAway(): void {
    if (this.map.getLayer(CANVAS)) this.map.removeLayer(CANVAS);
    if (this.map.getSource(CANVAS)) this.map.removeSource(CANVAS);
  }
}

export const same = (one: Range, other: Range) => JSON.stringify(one) === JSON.stringify(other);

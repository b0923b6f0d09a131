/** The second map of a comparison: over the first one beyond the divider, with the same camera. It takes no clicks. */

import { Map as MapLibre, type RasterTileSource, type StyleSpecification } from 'maplibre-gl';

import { html } from '../dom';
import { LAYER } from '../map';

/** Layers of the first map that the second has as well. */
const SHARED = ['ground', 'base', LAYER];

/** Changes of the first map's style within this time, in milliseconds, are one for the second. */
const CALM_MS = 60;

export class OtherMap {
  readonly #box: HTMLElement;
  readonly #map: MapLibre;
  readonly #follow: () => void;
  #tiles: string;
  #style = '';
  #held = false;
  #timer: number | undefined;
  #styling = 0;

  /** `tiles`: their template, as the first map's sources have it. */
  constructor(private readonly first: MapLibre, tiles: string) {
    this.#tiles = tiles;
    this.#box = html('div', { class: 'other-map', 'aria-hidden': 'true' });
    // Below the first map's controls, over its picture.
    first.getContainer().insertBefore(this.#box, first.getContainer().querySelector('.maplibregl-control-container'));
    this.#map = new MapLibre({
      container: this.#box, style: this.#wanted(), interactive: false, attributionControl: false, renderWorldCopies: false,
      maxPitch: 85, canvasContextAttributes: { preserveDrawingBuffer: true },
      center: first.getCenter(), zoom: first.getZoom(), bearing: first.getBearing(), pitch: first.getPitch(),
    });
    this.#map.getCanvas().tabIndex = -1;
    this.#map.on('error', () => {});
    this.#style = JSON.stringify(this.#wanted());
    void this.#sayOnceDrawn();
    this.#follow = () => {
      this.#map.jumpTo({ center: first.getCenter(), zoom: first.getZoom(), bearing: first.getBearing(), pitch: first.getPitch() });
    };
    first.on('move', this.#follow);
    first.on('styledata', this.#restyleSoon);
    first.on('sourcedata', this.#restyleSoon);
    first.on('resize', this.#resize);
  }

  show(tiles: string): void {
    this.#tiles = tiles;
    this.#restyleSoon();
  }

  /** MapLibre's map, which pictures may be laid on. */
  get map(): MapLibre {
    return this.#map;
  }

  /** Resolves when sources and layers can be added. */
  async ready(): Promise<void> {
    if (!this.#map.isStyleLoaded()) await this.#map.once('style.load');
  }

  /** Keeps its tiles as they are until `release`. */
  hold(): void {
    this.#held = true;
    clearTimeout(this.#timer);
  }

  /** Shows the tiles of the present; resolves when they are drawn. What others have added to the map stays. */
  async release(): Promise<void> {
    this.#held = false;
    this.#styling += 1;
    document.body.dataset.compared = 'false';
    const style = this.#wanted();
    const layer = style.layers.find(({ id }) => id === LAYER);
    this.#map.getSource<RasterTileSource>(LAYER)?.setTiles([this.#tiles]);
    if (layer?.type === 'raster' && this.#map.getLayer(LAYER)) {
      this.#map.setPaintProperty(LAYER, 'raster-opacity', layer.paint?.['raster-opacity'] ?? 1);
    }
    this.#style = JSON.stringify(style);
    await this.#map.once('idle');
    this.#restyleSoon();
  }

  split(share: number): void {
    this.#box.style.setProperty('--split', String(share));
  }

  remove(): void {
    clearTimeout(this.#timer);
    this.#styling += 1;
    delete document.body.dataset.compared;
    this.first.off('move', this.#follow);
    this.first.off('styledata', this.#restyleSoon);
    this.first.off('sourcedata', this.#restyleSoon);
    this.first.off('resize', this.#resize);
    this.#map.remove();
    this.#box.remove();
  }

  readonly #resize = () => this.#map.resize();

  readonly #restyleSoon = () => {
    clearTimeout(this.#timer);
    if (this.#held) return;
    this.#styling += 1;
    document.body.dataset.compared = 'false';
    this.#timer = window.setTimeout(() => {
      const style = this.#wanted();
      const key = JSON.stringify(style);
      if (key !== this.#style) {
        this.#style = key;
        this.#map.setStyle(style);
        this.#follow();
      }
      void this.#sayOnceDrawn();
    }, CALM_MS);
  };

  /** Whoever drives the page by a program can read off whether this map shows what it was last asked for. */
  async #sayOnceDrawn(): Promise<void> {
    document.body.dataset.compared = 'false';
    const styling = this.#styling;
    this.#map.triggerRepaint(); // a map at rest is not idle once more
    await this.#map.once('idle');
    if (styling === this.#styling) document.body.dataset.compared = 'true';
  }

  /** The first map's style, with other tiles. */
  #wanted(): StyleSpecification {
    const { sources, layers, terrain } = this.first.getStyle();
    const shared = layers.filter(({ id }) => SHARED.includes(id));
    const names = new Set(shared.flatMap((layer) => ('source' in layer ? [layer.source] : [])));
    if (terrain) names.add(terrain.source);
    const kept = Object.fromEntries(Object.entries(sources).filter(([name]) => names.has(name)));
    const level = kept[LAYER];
    if (level?.type === 'raster') {
      // A TileJSON's own address would go before the tiles.
      const { url, ...rest } = level;
      kept[LAYER] = { ...rest, tiles: [this.#tiles] };
    }
    return { version: 8, sources: kept, layers: shared, ...(terrain ? { terrain } : {}) };
  }
}

/** The map: a base map if one is chosen, the service's layer on it, and 3D terrain. */

import {
  AttributionControl, Map as MapLibre, NavigationControl, ScaleControl, type RasterTileSource, addProtocol, setWorkerUrl,
} from 'maplibre-gl';
import workerUrl from 'maplibre-gl/dist/maplibre-gl-worker.mjs?worker&url';
import 'maplibre-gl/dist/maplibre-gl.css';

import type { BaseSource } from './base_maps';
import { isFolding } from './layout';
import type { PlacedLevel, TileJson } from './service';
import type { View } from './state';
import type { Tiles } from './tiles';

setWorkerUrl(workerUrl);

const GROUND = 'ground';
const BASE = 'base';
const HEIGHTS = 'heights';
/** The source and layer of the service's picture; what is drawn above it goes in after it. */
export const LAYER = 'level';
/** Of tiles' addresses in sources: they are loaded by the page itself. */
export const SCHEME = 'tile://';
const TILE_PX = 256;
const STEEPEST = 70;
/** The pitch that three dimensions begin with. */
const OBLIQUE = 55;

/** On a dense screen each tile covers fewer CSS pixels: the next zoom is drawn, one tile pixel to one screen pixel. */
const DENSITY = window.devicePixelRatio > 1.4 ? 2 : 1;
/** MapLibre counts zooms for tiles of 512 pixels. */
const ZOOM_SHIFT = Math.log2((512 * DENSITY) / TILE_PX);
/** Tiles are as wide as this in CSS pixels. */
export const TILE_SIZE = TILE_PX / DENSITY;

export class LevelMap {
  readonly map: MapLibre;
  #shown = '';
  #base = 'null';
  #heights = '';

  /** Throws if the browser cannot draw it. */
  constructor(container: HTMLElement, tiles: Tiles, still: boolean) {
    // MapLibre's own loading keeps 404s to itself, gives no Retry-After and says "AJAXError"; hence a loader of our own.
    addProtocol('tile', async ({ url }, controller) => ({ data: await tiles.bytes(url.slice(SCHEME.length), controller.signal) }));
    this.map = new MapLibre({
      container,
      style: { version: 8, sources: {}, layers: [{ id: GROUND, type: 'background', paint: { 'background-color': '#888888' } }] },
      attributionControl: false,
      renderWorldCopies: false,
      maxPitch: 0,
      fadeDuration: still ? 0 : 300,
      // What is seen can be saved as a picture.
      canvasContextAttributes: { preserveDrawingBuffer: true },
      locale: { 'Map.Title': 'Map of the level' },
    });
    this.map.addControl(new AttributionControl({ compact: isFolding() }), 'bottom-right');
    this.map.addControl(new ScaleControl({ maxWidth: 110 }), 'bottom-right');
    this.map.addControl(new NavigationControl({ visualizePitch: true }), 'top-right');
    // Failed tiles have been told by the loader; the listener keeps MapLibre from telling them to the console again.
    this.map.on('error', () => {});
  }

  /** Colours the map where nothing is. */
  paintGround(color: string): void {
    this.map.setPaintProperty(GROUND, 'background-color', color);
  }

  /** Shows tiles of a level; those on screen stay until the new ones are there, unless `key` has changed: they mean something else. */
  showLayer(key: string, tileJson: Omit<TileJson, 'name' | 'skugga'>): void {
    const tiles = tileJson.tiles.map((tile) => SCHEME + tile);
    if (this.#shown === key) {
      this.map.getSource<RasterTileSource>(LAYER)?.setTiles(tiles);
      return;
    }
    const above = this.#shown && this.map.getStyle().layers.map(({ id }) => id).find((_, index, ids) => ids[index - 1] === LAYER);
    this.#remove(LAYER);
    this.#shown = key;
    this.map.addSource(LAYER, {
      type: 'raster',
      tiles,
      tileSize: TILE_SIZE,
      bounds: [...tileJson.bounds],
      minzoom: tileJson.minzoom,
      maxzoom: tileJson.maxzoom,
      attribution: tileJson.attribution ?? '',
    });
    this.map.addLayer({ id: LAYER, type: 'raster', source: LAYER, paint: { 'raster-fade-duration': 150, 'raster-opacity-transition': { duration: 0 } } }, above || undefined);
  }

  /** Takes the layer away: a level that cannot show it. */
  hideLayer(): void {
    this.#remove(LAYER);
    this.#shown = '';
  }

  setOpacity(opacity: number): void {
    if (this.map.getLayer(LAYER)) this.map.setPaintProperty(LAYER, 'raster-opacity', opacity);
  }

  /** Puts a base map of XYZ tiles under the layer; null: none. */
  showBase(base: BaseSource | null): void {
    const key = JSON.stringify(base);
    if (key === this.#base) return;
    this.#base = key;
    this.#remove(BASE);
    if (!base) return;
    const { tiles, attribution, maxzoom } = base;
    this.map.addSource(BASE, { type: 'raster', tiles: [tiles], tileSize: TILE_PX, attribution, maxzoom });
    const first = this.map.getStyle().layers.find(({ id }) => id !== GROUND);
    this.map.addLayer({ id: BASE, type: 'raster', source: BASE }, first?.id);
  }

  /** Lets the ground rise from heights of the service, given as a template of tiles; null lays it flat. */
  showSolid(heights: { template: string; level: PlacedLevel } | null, still: boolean): void {
    const solid = this.#heights !== '';
    const wanted = heights?.template ?? '';
    if (wanted === this.#heights) return;
    this.#heights = wanted;
    this.map.setTerrain(null);
    this.#removeSource(HEIGHTS);
    this.map.setMaxPitch(heights ? STEEPEST : 0);
    if (!heights) {
      if (solid) this.map.easeTo({ pitch: 0, animate: !still });
      return;
    }
    const { template, level } = heights;
    this.map.addSource(HEIGHTS, {
      type: 'raster-dem',
      encoding: 'mapbox',
      tiles: [SCHEME + template],
      tileSize: TILE_PX,
      bounds: [...level.bounds],
      minzoom: level.minzoom,
      maxzoom: level.maxzoom,
    });
    this.map.setTerrain({ source: HEIGHTS });
    if (!solid && this.map.getPitch() === 0) this.map.easeTo({ pitch: OBLIQUE, animate: !still });
  }

  /** Lets the map look at all of a level, beside what covers its edges. */
  fit(level: PlacedLevel, padding: { top: number; bottom: number; left: number; right: number }): void {
    const [west, south, east, north] = level.bounds;
    this.map.fitBounds([[west, south], [east, north]], { padding, animate: false, bearing: 0, pitch: this.map.getPitch() });
  }

  look({ zoom, lat, lon, bearing, pitch }: View): void {
    this.map.jumpTo({ zoom, center: [lon, lat], bearing, pitch });
  }

  get view(): View {
    const { lat, lng } = this.map.getCenter();
    return { zoom: this.map.getZoom(), lat, lon: lng, bearing: this.map.getBearing(), pitch: this.map.getPitch() };
  }

  /** Further out than the first zoom there is nothing to see; further in than two past the last, only blur. */
  limitZoom(level: PlacedLevel | null): void {
    this.map.setMinZoom(level ? Math.max(0, level.minzoom - ZOOM_SHIFT - 1) : 0);
    this.map.setMaxZoom(level ? level.maxzoom + 2 : 22);
  }

  /** Whether any of a level can be seen. */
  sees(level: PlacedLevel): boolean {
    const [west, south, east, north] = level.bounds;
    const seen = this.map.getBounds();
    return seen.getWest() < east && seen.getEast() > west && seen.getSouth() < north && seen.getNorth() > south;
  }

  /** The zoom of the tiles on screen, within those that there are. */
  tileZoom({ minzoom, maxzoom }: PlacedLevel): number {
    return Math.min(Math.max(Math.round(this.map.getZoom() + ZOOM_SHIFT), minzoom), maxzoom);
  }

  #remove(id: string): void {
    if (this.map.getLayer(id)) this.map.removeLayer(id);
    this.#removeSource(id);
  }

  #removeSource(id: string): void {
    if (this.map.getSource(id)) this.map.removeSource(id);
  }
}
